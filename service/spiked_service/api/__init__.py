"""The HTTP face of the service."""

from spiked_service.api.app import create_app

__all__ = ["create_app"]

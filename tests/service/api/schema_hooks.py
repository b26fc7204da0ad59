"""Hooks of schemathesis: valid idempotency keys are new, because reused ones are refused with 422."""

import re
import uuid
from typing import Any

import schemathesis

_HEADER = "Idempotency-Key"


@schemathesis.hook
def before_call(context: schemathesis.HookContext, case: Any, kwargs: dict[str, Any]) -> None:
    """Replace a valid key; others are sent as they were generated."""
    key = (case.headers or {}).get(_HEADER)
    if isinstance(key, str) and re.fullmatch("[!-~]{1,255}", key):
        case.headers[_HEADER] = str(uuid.uuid4())

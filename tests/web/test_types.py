"""The types that the page is checked with are those of the service's schema."""

import subprocess
import sys
from pathlib import Path

import pytest

WEB = Path(__file__).resolve().parents[2] / "web"
GENERATOR = WEB / "node_modules" / ".bin" / "openapi-typescript"


def test_the_types_are_those_that_the_service_describes(tmp_path: Path) -> None:
    if not GENERATOR.exists():
        pytest.skip("openapi-typescript is not installed (make page)")
    schema, types = tmp_path / "openapi.json", tmp_path / "schema.d.ts"
    subprocess.run([sys.executable, "-m", "spiked_service", "openapi", "--out", str(schema)], check=True)
    subprocess.run([GENERATOR, schema, "-o", types, "--default-non-nullable=false"], check=True, cwd=WEB)
    assert (WEB / "src" / "shared" / "api" / "schema.d.ts").read_text() == types.read_text(), "run make api"

"""What the builders of packages share: where the sources are, other programs, and the time that goes into files."""

import os
import subprocess
import sys
from pathlib import Path

DEPLOY = Path(__file__).parent
ROOT = DEPLOY.parent


def run(*command: str | Path, **variables: str) -> str:
    """Standard output of a program; ends this one if it fails."""
    words = [str(word) for word in command]
    done = subprocess.run(words, env={**os.environ, **variables}, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        sys.exit(f"error: {' '.join(words)} failed:\n{done.stdout}")
    return done.stdout


def epoch() -> str:
    """SOURCE_DATE_EPOCH, or seconds since 1970 of the last commit; outside of a git repository those of the start of
    ZIP's calendar."""
    stated = os.environ.get("SOURCE_DATE_EPOCH")
    if stated:
        return stated
    done = subprocess.run(["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "315532800"

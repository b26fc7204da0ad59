"""The sign-in form for browsers without a token. It uses no files of the page, which require a token."""

import base64
import hashlib
import html
import math
from http import HTTPStatus
from urllib.parse import urlencode, urlsplit

from starlette.responses import HTMLResponse

PATH = "/sign-in"
_STYLE = """
:root { color-scheme: light dark; --paper: #eef1f4; --panel: #fff; --line: #d5dce4; --edge: #7d8b9b; --ink: #17202a;
  --dim: #566474; --accent: #0b6b82; --on-accent: #fff; --problem: #b23a10;
  font: 14px/1.5 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #0d1117; --panel: #141a22; --line: #26303c; --edge: #5b6a7c; --ink: #dfe6ee; --dim: #93a1b1;
    --accent: #4fc3dc; --on-accent: #06222a; --problem: #f2805a; } }
* { box-sizing: border-box; }
body { margin: 0; min-height: 100dvh; display: grid; place-items: center; background: var(--paper); color: var(--ink); }
main { width: min(360px, calc(100vw - 28px)); padding: 22px 24px; background: var(--panel);
  border: 1px solid var(--line); border-radius: 6px; }
h1 { margin: 0 0 4px; font-size: 17px; }
p { margin: 0 0 14px; }
.dim { color: var(--dim); margin: 14px 0 0; font-size: 12.5px; }
.problem { color: var(--problem); }
label { display: block; margin-bottom: 4px; }
input, button { font: inherit; min-height: 38px; border-radius: 5px; width: 100%; color: inherit; }
input { padding: 3px 8px; background: var(--paper); border: 1px solid var(--edge); }
button { margin-top: 10px; background: var(--accent); border: 0; color: var(--on-accent); font-weight: 600;
  cursor: pointer; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
code { font-size: 12px; }
"""
_POLICY = (
    f"default-src 'none'; style-src 'sha256-{base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()}'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
"""Stricter than the page's: nothing is fetched, and only this style sheet is applied."""


def form(wrong: bool, wanted: str, wait_s: float = 0.0) -> HTMLResponse:
    """The form, with a message if the last token was `wrong`; it leads to the page with the query `wanted`.

    `wait_s`: seconds for which no token is checked, after too many wrong ones.
    """
    why = "This token is not valid."
    if wait_s:
        why = f"Too many wrong tokens from this address: wait {math.ceil(wait_s)} seconds, then try again."
    message = f"<p class=problem role=alert>{why}</p>" if wrong else ""
    action = f"{PATH}?{urlencode({'then': wanted})}" if wanted else PATH
    page = (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>Sign in · spiked</title><style>{_STYLE}</style>"
        "<main><h1>spiked</h1><p>This service requires a token.</p>"
        f"{message}<form method=post action='{html.escape(action)}'>"
        "<label for=token>Token</label>"
        "<input id=token type=password name=token required autofocus autocomplete=current-password>"
        "<button>Sign in</button></form>"
        "<p class=dim>Create one on the server: <code>spiked token create NAME</code>.</p></main></html>"
    )
    headers = {
        "WWW-Authenticate": "Bearer",
        "Cache-Control": "no-store",
        "Content-Security-Policy": _POLICY,
        # With no-referrer, the policy of the service, browsers post a form with `Origin: null`, which is refused.
        "Referrer-Policy": "same-origin",
    }
    if wait_s:
        headers["Retry-After"] = str(math.ceil(wait_s))
    return HTMLResponse(page, HTTPStatus.TOO_MANY_REQUESTS if wait_s else HTTPStatus.UNAUTHORIZED, headers)


def landing(wanted: str) -> str:
    """The path after signing in: the page with the query `wanted`, never another site."""
    query = urlsplit(f"/?{wanted}").query
    return f"/?{query}" if query else "/"

"""What the pages of the site run, as files of their own: the daemon's policy forbids scripts inside a page.

The theme writes scripts into each page and, for the search from disk, names one on another server. Neither works where
the site is served by the daemon or read without a network.
"""

import hashlib
import re
import shutil
from pathlib import Path

FOLDER = "assets/javascripts"
SEARCH = "search_from_disk.js"
_SHIM = re.compile(r'<script src="https://unpkg\.com/iframe-worker/shim"></script>')
_INLINE = re.compile(r"<script>(.*?)</script>", re.DOTALL)
_UNUSED = (f"{FOLDER}/lunr", "404.html", "sitemap.xml", "sitemap.xml.gz")
"""Word lists of other languages, and files that only a site with an address of its own has."""
_SEARCH_TEXT = """// Browsers start no worker from a file: there the search runs in a hidden frame instead.
"use strict";
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(script) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const inner = frame.contentWindow;
      inner.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      this.started = new Promise((resolve, reject) => {
        const element = inner.document.createElement("script");
        element.onload = () => resolve(inner);
        element.onerror = reject;
        element.src = new URL(script, location);
        inner.document.body.append(element);
      });
    }
    postMessage(data) {
      this.started.then((inner) => inner.dispatchEvent(new MessageEvent("message", { data })));
    }
    terminate() {}
  };
}
"""


def without_inline(html: str, site: Path, url: str) -> str:
    """A page of the site with its scripts written to files, named by their content; `url` is the page's own address."""
    up = "../" * url.count("/")

    def moved(match: re.Match[str]) -> str:
        text = match[1].strip()
        name = f"inline.{hashlib.sha256(text.encode()).hexdigest()[:8]}.js"
        target = site / FOLDER / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text + "\n", encoding="utf-8")
        return f'<script src="{up}{FOLDER}/{name}"></script>'

    html = _SHIM.sub(f'<script src="{up}{FOLDER}/{SEARCH}"></script>', html)
    return _INLINE.sub(moved, html)


def finish(site: Path) -> None:
    """Write the script of the search from disk, and remove what nothing reads."""
    (site / FOLDER / SEARCH).write_text(_SEARCH_TEXT, encoding="utf-8")
    for name in _UNUSED:
        path = site / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    for path in (site / "assets").rglob("*.map"):
        path.unlink()

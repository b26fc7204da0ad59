"""Measure the page with many jobs: how long it loads, what an event costs it, its memory, and how soon it answers.

    .venv/bin/python evaluation/measure_queue_page.py [--jobs 100000] [--pictures FOLDER]

The service and its jobs are those of `measure_queue.py`. Work is CPU time of the page's main thread, by Chromium's
`Performance.getMetrics`: in scripts, and all with layout and style. Times until something is shown are those of a
clock. An event is a change of a place at the front of the queue, which tells of a hundred jobs, or the end of a job.
"""

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
from measure_queue import Filled, fill, served
from playwright.sync_api import sync_playwright
from spiked_service.store.rows import JobState

MOVES, ENDS = 40, 1000
"""Events on each page."""
WATCH = """shown => {
    window.shownAt = new Promise(done => {
        const look = () => requestAnimationFrame(document.querySelector(shown) ? () => done(performance.now()) : look);
        look();
    });
    const note = event => { window.actedAt = event.timeStamp; };
    addEventListener("click", note, { capture: true, once: true });
}"""
"""Notes when a click comes, and the first frame with what it leads to."""


class Page:
    """A page, and what it has used."""

    def __init__(self, context: Any, address: str, ready: str) -> None:
        self.page = context.new_page()
        self._devtools = context.new_cdp_session(self.page)
        self._devtools.send("Performance.enable", {"timeDomain": "threadTicks"})
        begun = time.perf_counter()
        self.page.goto(address)
        self.page.locator(ready).first.wait_for()
        self.loaded_ms = 1000 * (time.perf_counter() - begun)
        self.page.wait_for_timeout(1000)

    def metrics(self, *, collected: bool = True) -> dict[str, float]:
        """Seconds of work since the page was opened, and bytes of the heap, after a collection."""
        if collected:
            self._devtools.send("HeapProfiler.collectGarbage")
        found = {one["name"]: one["value"] for one in self._devtools.send("Performance.getMetrics")["metrics"]}
        return {name: found[name] for name in ("ScriptDuration", "TaskDuration", "JSHeapUsedSize", "Nodes")}

    def cost(self, name: str, number: int, work: Callable[[], None]) -> None:
        """Print what some events cost the page."""
        before = self.metrics()
        work()
        self.page.wait_for_timeout(1000)
        after = self.metrics()
        script, task = (1000 * (after[key] - before[key]) / number for key in ("ScriptDuration", "TaskDuration"))
        print(f"| {name}, each | {script:.1f} | {task:.1f} | {after['JSHeapUsedSize'] / 1e6:.1f} |")

    def answer(self, name: str, act: Callable[[], None], shown: str) -> None:
        """Print how long it takes from an action until the next frame that shows its effect."""
        self.page.evaluate(WATCH, shown)
        before = self.metrics()
        act()
        took = self.page.evaluate("async () => (await window.shownAt) - window.actedAt")
        work = {key: 1000 * (value - before[key]) for key, value in self.metrics(collected=False).items()}
        print(f"| {name} | {work['ScriptDuration']:.0f} | {work['TaskDuration']:.0f} | {took:.0f} ms |")


def main() -> None:
    """Fill, start, look."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=100_000)
    parser.add_argument("--captures", type=int, default=1000)
    parser.add_argument("--pictures", type=Path, help="folder for screenshots")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as driver:
        filled = fill(Path(scratch) / "data", given.jobs, given.captures)
        chromium = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        context = chromium.new_context(viewport={"width": 1280, "height": 800})
        with served(Path(scratch) / "data", {}) as (http, _):
            look(context, str(http.base_url).replace("api/v1/", ""), http, filled, given.pictures)
        chromium.close()


def look(context: Any, address: str, http: httpx.Client, filled: Filled, pictures: Path | None) -> None:
    """Open the pages, and let jobs move and end."""
    large = filled.captures[0]
    print("| page | script, ms | all work, ms | heap, MB, or until shown |\n|---|---|---|---|")
    for name, query, ready in (
        ("Live", "", "ol.queue li"),
        ("Captures", "?page=captures", "table.list tbody tr"),
        ("LARGE", f"?page=captures&capture={large}", "table.jobs tbody tr"),
    ):
        opened = Page(context, f"{address}{query}", ready)
        used = opened.metrics()
        print(
            f"| {name}, loaded after {opened.loaded_ms:.0f} ms | {1000 * used['ScriptDuration']:.0f} | "
            f"{1000 * used['TaskDuration']:.0f} | {used['JSHeapUsedSize'] / 1e6:.1f} |"
        )
        opened.cost(f"{name}: moves at the front", MOVES, lambda: move(http))
        opened.cost(f"{name}: jobs that end", ENDS, lambda: end(http, filled, ENDS))
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            opened.page.screenshot(path=pictures / f"{name.lower()}.png")
        if name == "Live":
            hold = opened.page.get_by_role("button", name="Hold the reconstruction").first
            row = hold.evaluate("button => [...button.closest('ol').children].indexOf(button.closest('li')) + 1")
            opened.answer("Live: to hold a job", hold.click, f"ol.queue li:nth-child({row}) button[aria-pressed=true]")
            captures = opened.page.get_by_role("link", name="Captures").first
            opened.answer("Live to Captures", captures.click, "table.list")
        if name == "LARGE":
            more = opened.page.get_by_role("button", name="Show more")
            opened.answer("LARGE: show more", more.click, "table.jobs tbody tr:nth-child(150)")
        opened.page.close()


def move(http: httpx.Client) -> None:
    """Move the job at place 60 to the front, again and again."""
    for _ in range(MOVES):
        items = http.get("reconstructions?in_turn=true&limit=60").json()["items"]
        http.patch(f"reconstructions/{items[-1]['id']}", json={"queue_place": 1}).raise_for_status()
        time.sleep(0.3)


def end(http: httpx.Client, filled: Filled, number: int) -> None:
    """Cancel jobs from the end of the queue."""
    for _ in range(number):
        http.post(f"reconstructions/{filled.jobs[JobState.QUEUED].pop()}:cancel").raise_for_status()


if __name__ == "__main__":
    main()

"""Many clients in one process: `clients.py events|views ADDRESS COUNT [...]`, until SIGTERM; then a report."""

import asyncio
import json
import signal
import sys
import time
from collections import Counter
from typing import Any

import httpx
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed


async def until_told(tasks: list["asyncio.Task[Any]"]) -> None:
    """Let the clients work until SIGTERM, or until one of them fails."""
    told = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, told.set)
    waiting = asyncio.create_task(told.wait())
    print("ready", flush=True)
    await asyncio.wait([waiting, *tasks], return_when=asyncio.FIRST_COMPLETED)
    for task in tasks:
        if task.done():
            task.result()
        task.cancel()


async def listen(address: str, report: dict[str, Any]) -> None:
    """One client: every message newer than the one before, and what it was told that it lost."""
    last = 0
    report.update(messages=Counter(), lost=Counter(), disorder=0)
    try:
        async with connect(f"{address.replace('http', 'ws')}/api/v1/events", compression=None) as events:
            async for text in events:
                message = json.loads(text)
                if message["topic"] == "lost":
                    report["lost"].update(message["data"]["by_topic"])
                    continue
                report["disorder"] += message["seq"] <= last
                last = message["seq"]
                report["messages"][message["topic"]] += 1
    except ConnectionClosed as closed:
        report["closed"] = str(closed)


async def look(address: str, reconstruction: str, period_s: float, report: dict[str, Any]) -> None:
    """One client: a view now and then."""
    report.update(ms=[], status=Counter())
    body = {"camera": {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}}
    async with httpx.AsyncClient(timeout=60) as http:
        while True:
            start_s = time.perf_counter()
            answer = await http.post(f"{address}/api/v1/reconstructions/{reconstruction}/views", json=body)
            took_s = time.perf_counter() - start_s
            report["ms"].append(round(1000 * took_s, 2))
            report["status"][str(answer.status_code)] += 1
            await asyncio.sleep(max(0.0, period_s - took_s))


async def main() -> None:
    kind, address, count, *rest = sys.argv[1:]
    reports: list[dict[str, Any]] = [{} for _ in range(int(count))]
    if kind == "events":
        tasks = [asyncio.create_task(listen(address, report)) for report in reports]
    else:
        reconstruction, period_s = rest
        tasks = [asyncio.create_task(look(address, reconstruction, float(period_s), report)) for report in reports]
    await until_told(tasks)
    print(json.dumps(reports), flush=True)


asyncio.run(main())

"""How fast views come while mapping goes on: `python evaluation/measure_views.py [ADDRESS]`, with `spiked serve` there.

Starts a capture of the simulated camera (400x250), waits until its map is refined, and asks for views from along its
path with 1, 4 and 8 clients, each a thread with a connection of its own on the service's machine.
"""

import http.client
import json
import random
import socket
import statistics
import sys
import threading
import time
from urllib.parse import urlsplit

from spiked.client import JobState, ReconstructionOptions, Spiked

SECONDS = 5.0


def ask(address: str, path: str, bodies: list[bytes], took_s: list[float]) -> None:
    """Ask for views for a while, one after the other."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc)
    connection.connect()
    connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    end_s = time.perf_counter() + SECONDS
    while (start_s := time.perf_counter()) < end_s:
        connection.request("POST", path, random.choice(bodies), {"Content-Type": "application/json"})
        answer = connection.getresponse()
        answer.read()
        assert answer.status == 200, answer.reason
        took_s.append(time.perf_counter() - start_s)


def main() -> None:
    """Print a line for each format and number of clients."""
    address = sys.argv[1] if sys.argv[1:] else "http://127.0.0.1:8650"
    with Spiked(address) as spiked:
        capture = spiked.start_capture("sim:", frames=1280, options=ReconstructionOptions(steps=50_000))
        while not (ids := spiked.capture(capture.id).reconstruction_ids):
            time.sleep(0.2)
        while spiked.reconstruction(ids[0]).stage != "refining":
            time.sleep(0.2)
        time.sleep(5)
        path = spiked.trajectory(ids[0], step=50)
        cameras = zip(path.positions, path.quaternions_wxyz, strict=True)
        bodies = [json.dumps({"camera": {"position": p, "quaternion_wxyz": q}}).encode() for p, q in cameras]
        for clients in (1, 4, 8):
            for kind in ("jpeg", "png", "webp"):
                took_s: list[float] = []
                url = f"/api/v1/reconstructions/{ids[0]}/views?format={kind}"
                threads = [threading.Thread(target=ask, args=(address, url, bodies, took_s)) for _ in range(clients)]
                for thread in threads:
                    thread.start()
                for thread in threads:
                    thread.join()
                job = spiked.reconstruction(ids[0])
                assert job.state is JobState.running, "the map was refined before the measurement ended"
                ms = sorted(1000 * one for one in took_s)
                print(
                    f"{kind:5s} {clients} client(s): {len(ms) / SECONDS:5.0f} a second, median "
                    f"{statistics.median(ms):5.1f} ms, 99 % {ms[int(0.99 * len(ms))]:5.1f} ms, {job.splats} splats"
                )
        spiked.cancel_reconstruction(ids[0])


if __name__ == "__main__":
    main()

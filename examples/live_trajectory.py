"""Draw the camera's path while it is reconstructed: python live_trajectory.py [ws://127.0.0.1:8650]"""

import json
import sys

import matplotlib.pyplot as plt
from websockets.sync.client import connect

address = sys.argv[1] if len(sys.argv) > 1 else "ws://127.0.0.1:8650"
axes = plt.subplots()[1]
axes.set(xlabel="x", ylabel="z", aspect="equal", title="path from above")
(path,) = axes.plot([], [], ".-")
with connect(f"{address}/api/v1/events?topics=pose,job") as events:
    for message in map(json.loads, events):
        if message["topic"] == "pose":
            x, _, z = message["data"]["position"]
            path.set_data([*path.get_xdata(), x], [*path.get_ydata(), z])
        if message["topic"] == "job" or len(path.get_xdata()) % 10 == 0:
            axes.relim(), axes.autoscale_view(), plt.pause(0.01)
        if message["topic"] == "job" and message["data"]["state"] in ("complete", "cancelled", "failed"):
            break
plt.savefig("trajectory.png")

"""Print what happens in the service, over lost connections too: python events.py [ws://127.0.0.1:8650] [topics]"""

import json
import sys
import time

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

address = sys.argv[1] if len(sys.argv) > 1 else "ws://127.0.0.1:8650"
topics = sys.argv[2] if len(sys.argv) > 2 else "device,capture,job,scene,log"
since = ""
while True:
    try:
        with connect(f"{address}/api/v1/events?topics={topics}{since}") as events:
            for text in events:
                message = json.loads(text)
                since = f"&since={message['seq']}"
                print(message["seq"], message["topic"], json.dumps(message["data"])[:100], flush=True)
    except (ConnectionClosed, OSError) as error:
        print(f"no connection ({error}); trying again", file=sys.stderr)
    time.sleep(1)

"""Poses over ZeroMQ, noticing what was lost: python zmq_events.py [port of events, 8651] [of the state, the next]"""

import sys

import msgpack
import zmq

port = int(sys.argv[1]) if len(sys.argv) > 1 else 8651
state_port = int(sys.argv[2]) if len(sys.argv) > 2 else port + 1
context = zmq.Context()

question = context.socket(zmq.REQ)
question.connect(f"tcp://127.0.0.1:{state_port}")
question.send(msgpack.packb({"get": "state"}))
for message in msgpack.unpackb(question.recv())["messages"]:
    print("now:", message["topic"], message["data"].get("state", ""), flush=True)

events = context.socket(zmq.SUB)
events.connect(f"tcp://127.0.0.1:{port}")
events.subscribe(b"pose")
last = None
while True:
    _, packed = events.recv_multipart()
    message = msgpack.unpackb(packed)
    if last is not None and message["topic_seq"] != last + 1:
        print(f"lost {message['topic_seq'] - last - 1} poses", file=sys.stderr)
    last = message["topic_seq"]
    print(message["data"]["frame"], *message["data"]["position"], flush=True)

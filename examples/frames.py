"""Read the frames of a running capture from shared memory: python frames.py [http://127.0.0.1:8650] [CAPTURE]"""

import sys

from spiked.client import Spiked

address = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:8650"
with Spiked(address) as service:
    capture = sys.argv[2] if len(sys.argv) > 2 else next(one.id for one in service.captures() if one.ring)
    with service.frames(capture) as stream:
        frames = 0
        for block in stream:
            mean = block.spikes().mean()  # block.data has the bits as they lie in shared memory
            if not block.intact():
                continue  # overwritten while it was read: its frames count as lost
            frames += len(block.data)
            when = "" if block.unix_ns is None else f" at {block.unix_ns[0] / 1e9:.6f} s"
            print(f"frames {block.numbers[0]} to {block.numbers[-1]}{when}: rate {mean:.3f}, {block.lost} lost before")
        print(f"{stream.end}: {frames} frames read, {stream.lost} lost")

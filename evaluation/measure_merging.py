"""Measure how often `spiked merge` joins maps of different places: built-in rooms, each with textures of its own.

    .venv/bin/python evaluation/measure_merging.py [--pairs 200] [--seed 0]

Furniture stands alike in all rooms, and both cameras stand at the same place, so that only textures tell the rooms
apart. For every tenth pair the same room is merged with itself, seen from another place: these have to be found.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from spiked.recon import KnownMap, NotOnePlaceError
from spiked.recon.merging.joining import join
from spiked.render import Camera

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.room_map import OPTICS, SENSOR, room_map

LEFT, RIGHT = (0.0, 0.5), (0.45, 0.95)
"""Where the cameras of the two maps look, in radians."""


def known(seed: int, turns_rad: tuple[float, ...]) -> KnownMap:
    made = room_map(seed, turns_rad)
    return KnownMap(made.scene, made.path, Camera(OPTICS, SENSOR.width, SENSOR.height))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    false = found = same = 0
    errors: list[float] = []
    for pair in range(given.pairs + given.pairs // 10):
        own = pair % 11 == 10
        first, second = rng.integers(0, 10_000, 2).tolist()
        second = first if own else second + 10_000
        turns = RIGHT if own or pair % 2 else LEFT
        same += own
        try:
            joint = join(known(first, LEFT), known(second, turns))
        except NotOnePlaceError as error:
            if own:
                print(f"room {first}: {error}")
            continue
        if own:
            found += 1
            errors.append(abs(joint.registration.similarity.scale - 1))
        else:
            false += 1
            print(f"rooms {first} and {second}: JOINED, {len(joint.registration.sightings)} views agree")
    print(f"pairs of different rooms {given.pairs}, joined {false}")
    print(f"pairs of one room {same}, joined {found}, error of the scale at most {100 * max(errors, default=0):.2f} %")


if __name__ == "__main__":
    main()

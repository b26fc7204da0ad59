"""Tanks and Temples: pictures of the sequences that NoPe-NeRF and later papers without poses use."""

from dataclasses import replace

from spiked.datasets import colmap
from spiked.datasets.kind import UNKNOWN

KIND = replace(
    colmap.KIND,
    name="tanks-and-temples",
    title="Tanks and Temples, sequences with COLMAP poses",
    sensor="pictures of a video camera; spikes are made of them (the paper: 960 frames at 40 kHz, RGGB)",
    licence="stated at https://www.tanksandtemples.org/license/",
    size=UNKNOWN,
    published="https://www.tanksandtemples.org/download/, and https://nope-nerf.active.vision for the sequences that "
    "papers without poses use",
    get="download the sequences there (Ballroom, Barn, Church, Family, Francis, Horse, Ignatius, Museum) and unpack "
    "them into one folder, each with images/ and sparse/",
    citation="A. Knapitsch, J. Park, Q.-Y. Zhou and V. Koltun, Tanks and Temples: Benchmarking Large-Scale Scene "
    "Reconstruction, ACM TOG 2017; W. Bian et al., NoPe-NeRF, CVPR 2023",
    certainty="COLMAP's format is documented; the folders as far as known",
)

"""Deblur-NeRF: pictures of synthetic and real scenes with camera motion, in the folders of LLFF."""

from dataclasses import replace

from spiked.datasets import colmap
from spiked.datasets.kind import UNKNOWN

KIND = replace(
    colmap.KIND,
    name="deblur-nerf",
    title="Deblur-NeRF, scenes with camera motion blur",
    sensor="pictures, 600x400; spikes are made of them (the paper: 480 frames at 40 kHz, RGGB)",
    licence="the code is under the MIT licence; that of the pictures is " + UNKNOWN,
    size=UNKNOWN,
    published="https://github.com/limacv/Deblur-NeRF, https://limacv.github.io/deblurnerf/",
    get="follow the links to the data in the README there and unpack each scene, with images/ and sparse/0/",
    citation="L. Ma et al., Deblur-NeRF: Neural Radiance Fields from Blurry Images, CVPR 2022",
    layout=colmap.LAYOUT.rstrip() + "\npictures may be blurred: the sharp ones of hold-out views are among them\n",
    certainty="COLMAP's format is documented; the folders as far as known",
)

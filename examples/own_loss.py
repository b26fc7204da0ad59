"""Train a scene with a loss of your own: the mean of an L1 loss and dissimilarity, by torch's Adam, from one picture.

pip install 'spiked[torch]'
spiked reconstruct rec.dat -o out
python examples/own_loss.py out/scene.ply out/trained.ply
"""

import sys

import torch

from spiked.render import Camera
from spiked.render.torch import dssim, render
from spiked.scene import Scene
from spiked.sensor import Intrinsics

scene = Scene.read_ply(sys.argv[1])
camera = Camera(Intrinsics.from_fov(400, 250, 60), 400, 250)
rotation, centre = torch.eye(3)[None], torch.zeros(1, 3)  # camera to world: where the first view stood
target = render(camera, scene.to_torch(), rotation, centre).values  # replace it by a picture of yours, [H, W]

splats = {name: tensor.requires_grad_() for name, tensor in scene.to_torch().items()}
with torch.no_grad():
    splats["colours"] *= 0.5  # something to do
optimiser = torch.optim.Adam(splats.values(), lr=0.01)
for step in range(100):
    optimiser.zero_grad()
    image = render(camera, splats, rotation, centre).values
    loss = 0.8 * (image - target).abs().mean() + 0.2 * dssim(image, target, white=scene.colour_of_white)
    loss.backward()
    optimiser.step()
    if step % 10 == 0:
        print(f"step {step}: loss {loss.item():.5f}")
Scene.from_torch(splats, scene.white).write_ply(sys.argv[2])

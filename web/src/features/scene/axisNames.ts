/** Names at the ends of the axes, so that colour is not the only difference. */

import { CanvasTexture, Group, Sprite, SpriteMaterial } from "three";

import { colour } from "../../shared/state/theme";

const SIDE_PX = 64;
const SIZE = 0.22;

/** The ends of axes of length 1 of the OpenCV world, in three.js' axes. */
const ENDS = [
  { name: "x", at: [1.12, 0, 0] },
  { name: "y", at: [0, -1.12, 0] },
  { name: "z", at: [0, 0, -1.12] },
] as const;

export function axisNames(): Group {
  const group = new Group();
  for (const { name, at } of ENDS) {
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = SIDE_PX;
    const pen = canvas.getContext("2d");
    if (pen === null) continue;
    pen.font = `600 ${0.7 * SIDE_PX}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.lineWidth = 6;
    pen.strokeStyle = colour("glass");
    pen.strokeText(name, SIDE_PX / 2, SIDE_PX / 2);
    pen.fillStyle = colour(`axis-${name}`);
    pen.fillText(name, SIDE_PX / 2, SIDE_PX / 2);
    const sprite = new Sprite(new SpriteMaterial({ map: new CanvasTexture(canvas), depthTest: false }));
    sprite.position.fromArray(at);
    sprite.scale.setScalar(SIZE);
    sprite.renderOrder = 11;
    group.add(sprite);
  }
  return group;
}

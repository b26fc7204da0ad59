/** What the splats show: their colour, or depth, normals, opacity, number, or where they are. */

import { dyno, modifiers, type GsplatModifier, type SplatMesh } from "@sparkjsdev/spark";

export const VIEW_MODES = ["colour", "depth", "normals", "opacity", "count", "points"] as const;
export type ViewMode = (typeof VIEW_MODES)[number];

/** Names and meanings, for people. */
export const MODE_TEXTS: Record<ViewMode, { label: string; meaning: string }> = {
  colour: { label: "Colour", meaning: "The scene as the camera sees it" },
  depth: { label: "Depth", meaning: "Bright is near, dark is far; each halving of the distance is as much brighter" },
  normals: { label: "Normals", meaning: "The direction of the flat side of each splat as red, green and blue" },
  opacity: { label: "Opacity", meaning: "White: nothing is seen through it; black: there is nothing" },
  count: { label: "Number of splats", meaning: "The more splats lie behind each other, the brighter: half is about 5" },
  points: { label: "Points", meaning: "The centre of each splat, however large or transparent it is" },
};

/** Nearest and farthest depth that differ in brightness, over the depth of the scene. */
const DEPTH_RANGE = [1 / 8, 4] as const;
/** Opacity of each splat where they are counted: 1 - (1 - 1/8)^5 is a half. */
const COUNTED_OPACITY = 1 / 8;
/** Radius of a point over the depth of the scene. */
const POINT_SIZE = 1 / 500;

const changed = (
  change: (gsplat: dyno.DynoVal<typeof dyno.Gsplat>) => dyno.DynoVal<typeof dyno.Gsplat>,
): GsplatModifier =>
  dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) =>
    gsplat === undefined ? undefined : { gsplat: change(gsplat) },
  );

const number = (value: number): dyno.DynoVal<"float"> => dyno.dynoConst("float", value);
const white = (): { r: dyno.DynoVal<"float">; g: dyno.DynoVal<"float">; b: dyno.DynoVal<"float"> } => ({
  r: number(1),
  g: number(1),
  b: number(1),
});

/** Show a mesh in a mode; `depth` is the distance of the scene. */
export function show(mesh: SplatMesh, mode: ViewMode, depth: number): void {
  mesh.enableWorldToView = mode === "depth" || mode === "normals";
  mesh.worldModifiers = modifiersOf(mesh, mode, depth);
  mesh.updateGenerator();
}

function modifiersOf(mesh: SplatMesh, mode: ViewMode, depth: number): GsplatModifier[] {
  const { worldToView } = mesh.context;
  switch (mode) {
    case "colour":
      return [];
    case "depth":
      return [
        changed((gsplat) => {
          const grey = nearness(worldToView.apply(dyno.splitGsplat(gsplat).outputs.center), depth);
          return dyno.combineGsplat({ gsplat, r: grey, g: grey, b: grey });
        }),
      ];
    case "normals":
      return [modifiers.makeNormalColorModifier(worldToView)];
    case "opacity":
      return [changed((gsplat) => dyno.combineGsplat({ gsplat, ...white() }))];
    case "count":
      return [changed((gsplat) => dyno.combineGsplat({ gsplat, ...white(), opacity: counted(gsplat) }))];
    case "points": {
      const size = number(POINT_SIZE * depth);
      const scales = dyno.combine({ vectorType: "vec3", x: size, y: size, z: size });
      return [changed((gsplat) => dyno.combineGsplat({ gsplat, scales, opacity: present(gsplat, 1) }))];
    }
  }
}

/** Brightness of a place in the axes of the camera: falls with the logarithm of its depth. */
function nearness(place: dyno.DynoVal<"vec3">, depth: number): dyno.DynoVal<"float"> {
  const [near, far] = [Math.log2(DEPTH_RANGE[0] * depth), Math.log2(DEPTH_RANGE[1] * depth)];
  const ahead = dyno.max(dyno.neg(dyno.split(place).outputs.z), number(1e-6));
  const share = dyno.div(dyno.sub(number(far), dyno.log2(ahead)), number(far - near));
  return dyno.clamp(share, number(0), number(1));
}

/** An opacity for splats that are there; empty slots have none. */
const present = (gsplat: dyno.DynoVal<typeof dyno.Gsplat>, opacity: number): dyno.DynoVal<"float"> =>
  dyno.select(dyno.greaterThan(dyno.splitGsplat(gsplat).outputs.opacity, number(0)), number(opacity), number(0));
const counted = (gsplat: dyno.DynoVal<typeof dyno.Gsplat>): dyno.DynoVal<"float"> => present(gsplat, COUNTED_OPACITY);

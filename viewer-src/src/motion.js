// The 3-D view of a simulated motion: the coloured surface of a deforming object, rigid indenters, and time.
import {
  Box3, BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry, CylinderGeometry, DataTexture, DirectionalLight, DoubleSide, EdgesGeometry, Group,
  HemisphereLight, LineBasicMaterial, LineDashedMaterial, LineSegments, LinearFilter, Matrix4, Mesh, MeshLambertMaterial, Scene,
  ShaderMaterial, Sphere, SphereGeometry,
} from "three";
import { gridLines, lines, sharpEdges } from "./body.js";
import { colourTable, niceCeiling } from "./colormap.js";
import { readTheme, View } from "./view.js";

export const VERTEX = `
attribute float level;
varying vec3 seen;
varying float shade;
void main() {
  vec4 p = modelViewMatrix * vec4(position, 1.0);
  seen = p.xyz;
  shade = level;
  gl_Position = projectionMatrix * p;
}`;

// Lit gently from the camera, so that the colours keep their meaning.
export const FRAGMENT = `
uniform sampler2D colours;
varying vec3 seen;
varying float shade;
void main() {
  vec3 n = normalize(cross(dFdx(seen), dFdy(seen)));
  float light = 0.72 + 0.28 * clamp(dot(n, normalize(vec3(0.25, 0.55, 0.8))), 0.0, 1.0);
  gl_FragColor = vec4(texture2D(colours, vec2((0.5 + 255.0 * clamp(shade, 0.0, 1.0)) / 256.0, 0.5)).rgb * light, 1.0);
}`;

/** Node pairs of the edges of square faces: those of the triangles but their longest one. */
function squareEdges(points, faces) {
  const seen = new Set();
  const out = [];
  const length = (i, j) => Math.hypot(...[0, 1, 2].map((k) => points[3 * i + k] - points[3 * j + k]));
  for (let f = 0; f < faces.length; f += 3) {
    const pairs = [0, 1, 2].map((k) => [faces[f + k], faces[f + ((k + 1) % 3)]].sort((p, q) => p - q));
    pairs.sort((p, q) => length(...p) - length(...q)).slice(0, 2).forEach((pair) => {
      const key = pair.join();
      if (!seen.has(key)) out.push(...pair);
      seen.add(key);
    });
  }
  return new Uint32Array(out);
}

/** The shape of a rigid body in its own frame, whose third axis is a cylinder's. */
function shapeOf({ kind, size }) {
  if (kind === "box") return new BoxGeometry(2 * size[0], 2 * size[1], 2 * size[2]);
  if (kind === "sphere") return new SphereGeometry(size[0], 32, 20);
  if (kind === "capsule") return new CapsuleGeometry(size[0], 2 * size[1], 12, 32).rotateX(Math.PI / 2);
  return new CylinderGeometry(size[0], size[0], 2 * size[1], 40).rotateX(Math.PI / 2);
}

/** Corners of a box around a rigid body at a position, as a flat list. */
export function cornersOf({ kind, size, axes }, position) {
  const half = { box: size, sphere: [size[0], size[0], size[0]], cylinder: [size[0], size[0], size[1]], capsule: [size[0], size[0], size[0] + size[1]] }[kind];
  const out = [];
  for (let corner = 0; corner < 8; corner += 1) {
    const signs = [0, 1, 2].map((k) => ((corner >> k) & 1 ? half[k] : -half[k]));
    for (let a = 0; a < 3; a += 1) out.push(position[a] + signs[0] * axes[a] + signs[1] * axes[3 + a] + signs[2] * axes[6 + a]);
  }
  return out;
}

/** A rigid body as a translucent shape with its edges, turned as its axes say. */
export function rigidBody(body) {
  const group = new Group();
  const shape = shapeOf(body);
  const fill = new Mesh(shape, new MeshLambertMaterial({ transparent: true, opacity: 0.45, depthWrite: false, side: DoubleSide }));
  fill.renderOrder = 3;
  group.add(fill, new LineSegments(new EdgesGeometry(shape, 20), new LineBasicMaterial()));
  const [a, b, c] = [0, 3, 6].map((k) => body.axes.slice(k, k + 3));
  group.quaternion.setFromRotationMatrix(new Matrix4().set(a[0], b[0], c[0], 0, a[1], b[1], c[1], 0, a[2], b[2], c[2], 0, 0, 0, 0, 1));
  return group;
}

export class MotionView extends View {
  /** Show a decoded motion at its first frame. */
  show(data) {
    this.data = data;
    this.clear();
    this.world = new Scene();
    this.extent = this.#extent();
    this.sun = new DirectionalLight(0xffffff, 1.4);
    this.position = new BufferAttribute(data.reference.slice(), 3);
    this.level = new BufferAttribute(new Float32Array(data.reference.length / 3), 1);
    this.skin = this.#skin();
    this.mesh = lines(this.position, squareEdges(data.reference, data.faces), new LineBasicMaterial({ transparent: true, opacity: 0.35 }));
    this.reference = lines(new BufferAttribute(data.reference, 3), sharpEdges(data.reference, data.faces, 35), new LineDashedMaterial({ dashSize: 2, gapSize: 1.5 }));
    this.reference.geometry = this.reference.geometry.toNonIndexed();
    this.reference.computeLineDistances();
    this.grid = gridLines(data.reference, niceCeiling(this.extent.radius / 6.5));
    this.frameful.push(this.grid.geometry.attributes.position.array);
    this.bodies = data.bodies.map((body) => (body.kind === "plane" ? null : rigidBody(body)));
    this.world.add(this.grid, this.reference, this.skin, this.mesh, ...this.bodies.filter(Boolean), new HemisphereLight(0xffffff, 0x8a8a8a, 2.0), this.sun);
    this.applyTheme();
    this.colourBy(0);
    this.setFrame(0);
    this.look("oblique");
  }

  /** Bounding sphere of the object and the rigid bodies at all times. */
  #extent() {
    const { reference, displacement, quantum, frames, bodies, positions } = this.data;
    const n = reference.length;
    const box = new Box3().setFromArray(reference);
    const moved = new Float32Array(n);
    for (let f = 0; f < frames; f += 1) {
      for (let i = 0; i < n; i += 1) moved[i] = reference[i] + quantum * displacement[f * n + i];
      box.union(new Box3().setFromArray(moved));
    }
    this.frameful = [[box.min, box.max].flatMap((p) => [box.min, box.max].flatMap((q) => [box.min, box.max].flatMap((r) => [p.x, q.y, r.z])))];
    const rigid = bodies.flatMap((body, k) => (body.kind === "plane" ? [] : positions.map((at) => cornersOf(body, at.slice(3 * k, 3 * k + 3)))));
    this.frameful.push(...rigid);
    rigid.forEach((corners) => box.union(new Box3().setFromArray(corners)));
    return box.getBoundingSphere(new Sphere());
  }

  #skin() {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", this.position);
    geometry.setAttribute("level", this.level);
    geometry.setIndex(new BufferAttribute(this.data.faces, 1));
    const material = new ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: { colours: { value: null } },
      side: DoubleSide,
      polygonOffset: true,
      polygonOffsetFactor: 1,
      polygonOffsetUnits: 1,
    });
    const mesh = new Mesh(geometry, material);
    mesh.frustumCulled = false;
    return mesh;
  }

  /** @param {number} frame 0 to number of frames - 1; fractions are interpolated */
  setFrame(frame) {
    const { reference, displacement, quantum, frames, positions } = this.data;
    this.frame = Math.min(frames - 1, Math.max(0, frame));
    const i = Math.min(frames - 1, Math.floor(this.frame));
    const j = Math.min(frames - 1, i + 1);
    const t = this.frame - i;
    const out = this.position.array;
    const n = reference.length;
    for (let k = 0; k < n; k += 1) out[k] = reference[k] + quantum * (displacement[i * n + k] * (1 - t) + displacement[j * n + k] * t);
    this.position.needsUpdate = true;
    this.bodies.forEach((group, b) => group?.position.set(...[0, 1, 2].map((a) => positions[i][3 * b + a] * (1 - t) + positions[j][3 * b + a] * t)));
    this.#colour(i, j, t);
    this.requestRender();
  }

  /** Colour by field number `index`; -1 + the number of fields is the last one. */
  colourBy(index) {
    this.field = this.data.fields[index];
    const texture = new DataTexture(colourTable(this.field.diverging), 256, 1);
    texture.minFilter = texture.magFilter = LinearFilter;
    texture.needsUpdate = true;
    this.skin.material.uniforms.colours.value?.dispose();
    this.skin.material.uniforms.colours.value = texture;
    this.setFrame(this.frame ?? 0);
  }

  #colour(i, j, t) {
    const out = this.level.array;
    const { levels } = this.field;
    for (let k = 0; k < out.length; k += 1) out[k] = (levels[i * out.length + k] * (1 - t) + levels[j * out.length + k] * t) / 255;
    this.level.needsUpdate = true;
  }

  setVisible(what, on) {
    const shown = { mesh: [this.mesh], reference: [this.reference], bodies: this.bodies.filter(Boolean) }[what];
    shown.forEach((object) => { object.visible = on; });
    this.requestRender();
  }

  /** Read the colours again from the page, after it turned light or dark. */
  applyTheme() {
    const theme = readTheme(this.host);
    this.renderer.setClearColor(theme.background);
    this.mesh.material.color.set(theme.dark ? "#000000" : "#1b1f23");
    this.reference.material.color.set(theme.edge);
    this.grid.material.color.set(theme.grid);
    this.bodies.filter(Boolean).forEach((group) => group.children.forEach((part) => part.material.color.set(theme.box)));
    this.requestRender();
  }
}

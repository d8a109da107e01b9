"use strict";
// A player of HOIGS_gaussian_motion, a glTF of moving 3D Gaussians (docs/reference/exports.md): read,
// place joints at a time, sort by depth, and draw as quads whose shader skins and morphs (WebGL2).
// Drawing follows Zwicker et al. 2002 (EWA) and Kerbl et al. 2023, as hoigs does.
(() => {
const $ = (id) => document.getElementById(id);
const SPLATTING = "KHR_gaussian_splatting", MOTION = "HOIGS_gaussian_motion";
const WIDTH = 2048;   // texels in a row of a texture
const TEXELS = 6;     // of a splat: position and opacity, quaternion, size and entity, colour, joints, weights
const CHANGE = 4;     // of a splat in a mode: position and opacity, quaternion, colour, logarithm of size
const C0 = 0.28209479177387814;

const fail = (text) => { $("message").textContent = text; $("message").hidden = false; $("message").style.display = ""; };

// ---- reading --------------------------------------------------------------------------------
let doc, bin, entities = [], moments, motion, total = 0;

function accessor(index) {
  const a = doc.accessors[index], width = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4, MAT4: 16 }[a.type];
  const out = new Float32Array(a.count * width);
  if (a.bufferView === undefined) return out;
  const view = doc.bufferViews[a.bufferView];
  const Kind = { 5120: Int8Array, 5121: Uint8Array, 5122: Int16Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array }[a.componentType];
  const size = Kind.BYTES_PER_ELEMENT, step = (view.byteStride || width * size) / size;
  const from = new Kind(bin, (view.byteOffset || 0) + (a.byteOffset || 0), step * (a.count - 1) + width);
  const unit = a.normalized ? { 5120: 127, 5121: 255, 5122: 32767, 5123: 65535 }[a.componentType] : 1;
  for (let i = 0; i < a.count; i++) for (let c = 0; c < width; c++) out[i * width + c] = Math.max(from[i * step + c] / unit, a.normalized ? -1 : -Infinity);
  return out;
}

async function inflated(bytes, kind) {
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream(kind))).arrayBuffer();
}

// the whole file: JSON, the binary part, and every mesh of Gaussians as an entity
async function open(buffer) {
  const head = new DataView(buffer);
  if (head.getUint32(0, true) !== 0x46546C67) throw new Error("this is no binary glTF");
  const length = head.getUint32(12, true);
  doc = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, length)));
  bin = buffer.slice(28 + length);
  motion = doc.extensions && doc.extensions[MOTION];
  if (!motion) throw new Error(`this glTF has no ${MOTION}, which hoigs export --format gltf-4d writes`);
  doc.nodes.forEach((node, i) => (node.children || []).forEach((c) => { doc.nodes[c].parent = i; }));
  const animation = doc.animations[0];
  moments = accessor(animation.samplers[0].input);
  for (const { sampler, target } of animation.channels) {
    const node = doc.nodes[target.node];
    (node.moves = node.moves || {})[target.path] = accessor(animation.samplers[sampler].output);
  }
  entities = []; total = 0;
  for (const node of doc.nodes) {
    const shape = node.mesh !== undefined && doc.meshes[node.mesh].primitives[0];
    if (shape && shape.extensions && shape.extensions[SPLATTING]) entities.push(await entity(node, shape));
  }
}

async function entity(node, shape) {
  const get = (name) => (shape.attributes[name] === undefined ? null : accessor(shape.attributes[name]));
  const e = {
    name: node.name, node, shown: true, first: total,
    position: get("POSITION"), quat: get(`${SPLATTING}:ROTATION`), scale: get(`${SPLATTING}:SCALE`),
    opacity: get(`${SPLATTING}:OPACITY`), dc: get(`${SPLATTING}:SH_DEGREE_0_COEF_0`),
    joints: get("JOINTS_0"), weights: get("WEIGHTS_0"),
    modes: (shape.targets || []).map((t) => accessor(t.POSITION)), changes: [], degree: 0,
  };
  e.count = e.opacity.length; total += e.count;
  e.bones = node.skin === undefined ? [node] : doc.skins[node.skin].joints.map((j) => doc.nodes[j]);
  e.inverse = node.skin === undefined ? null : accessor(doc.skins[node.skin].inverseBindMatrices);
  e.still = !e.modes.length && e.bones.every((b) => { for (; b; b = doc.nodes[b.parent]) if (b.moves) return false; return true; });
  const more = (shape.extensions[SPLATTING].extensions || {})[MOTION];
  if (more) {
    const view = doc.bufferViews[more.bufferView];
    e.bytes = new Int8Array(await inflated(new Uint8Array(bin, view.byteOffset || 0, view.byteLength), "deflate"));
    e.changes = more.targets || [];
    if (more.sh) { e.degree = more.sh.degree; e.sh = more.sh; }
  }
  return e;
}

// ---- placing at a time ----------------------------------------------------------------------
// the value of an animated property of a node at a frame, between moments blended
function at(node, path, width, otherwise) {
  const values = node.moves && node.moves[path];
  if (!values) return node[path] || otherwise;
  const a = Math.min(Math.floor(frame), moments.length - 1), b = Math.min(a + 1, moments.length - 1), r = frame - a;
  const out = new Array(width);
  let sign = 1;
  if (path === "rotation") {
    let dot = 0;
    for (let c = 0; c < 4; c++) dot += values[a * 4 + c] * values[b * 4 + c];
    sign = dot < 0 ? -1 : 1;
  }
  for (let c = 0; c < width; c++) out[c] = values[a * width + c] * (1 - r) + sign * values[b * width + c] * r;
  return path === "rotation" ? mul(out, 1 / Math.hypot(...out)) : out;
}

const turned = ([x, y, z, w]) => [
  1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
  2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
  2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];

// a 3 x 4 matrix, row by row, and a unit quaternion of the sign nearer to its parent's
function placed(node, known) {
  if (known.has(node)) return known.get(node);
  const t = at(node, "translation", 3, [0, 0, 0]), s = node.scale || [1, 1, 1];
  let q = at(node, "rotation", 4, [0, 0, 0, 1]);
  if (q[3] < 0) q = mul(q, -1);
  const r = turned(q);
  let made = { m: [0, 1, 2].flatMap((i) => [r[3 * i] * s[0], r[3 * i + 1] * s[1], r[3 * i + 2] * s[2], t[i]]), q };
  if (node.parent !== undefined) {
    const up = placed(doc.nodes[node.parent], known), [a, b, c, d] = up.q, [x, y, z, w] = q;
    made = { m: product(up.m, made.m), q: [d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x, d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z] };
  }
  known.set(node, made);
  return made;
}

function product(a, b) {
  const out = new Array(12);
  for (let i = 0; i < 3; i++) for (let j = 0; j < 4; j++) out[4 * i + j] = a[4 * i] * b[j] + a[4 * i + 1] * b[4 + j] + a[4 * i + 2] * b[8 + j] + (j === 3 ? a[4 * i + 3] : 0);
  return out;
}

// joints and modes of all entities, as the shader reads them; what is constant in `prepare`
let bones, shares;
function place() {
  const known = new Map();
  for (const e of entities) {
    e.matrices = e.bones.map((bone, j) => {
      const { m, q } = placed(bone, known), i = e.inverse && e.inverse.subarray(16 * j);
      const whole = i ? product(m, [i[0], i[4], i[8], i[12], i[1], i[5], i[9], i[13], i[2], i[6], i[10], i[14]]) : m;
      bones.set(whole, 16 * (e.joint + j)); bones.set(q, 16 * (e.joint + j) + 12);
      return whole;
    });
    const m = e.matrices[0], size = Math.hypot(m[0], m[4], m[8]);
    e.weight = e.modes.length ? at(e.node, "weights", e.modes.length, []) : [];
    const row = 4 * e.share;
    shares.set([size, e.modes.length, e.degree, e.change, e.band, e.count, e.sh ? e.sh.step : 0, e.first], row);
    e.weight.forEach((w, k) => {
      const step = (name) => w * ((e.changes[k] || {})[name] || { step: 0 }).step;
      shares.set([w * e.peak[k], step("ROTATION"), step("COLOR"), step("OPACITY"), step("SCALE"), 0, 0, 0], row + 8 + 8 * k);
    });
  }
}

// what does not change: a row of texels for every splat, its modes and its bands of SH
function layout() {
  const rows = (texels) => Math.max(1, Math.ceil(texels / WIDTH));
  let joints = 0, share = 0, change = 0, band = 0;
  for (const e of entities) {
    e.joint = joints; joints += e.bones.length;
    e.share = share; share += 2 + 2 * e.modes.length;
    e.change = change; change += CHANGE * e.count * e.modes.length;
    e.across = Math.ceil(3 * ((e.degree + 1) ** 2 - 1) / 4);
    e.band = band; band += e.across * e.count;
  }
  bones = new Float32Array(4 * WIDTH * rows(4 * joints)); shares = new Float32Array(4 * WIDTH * rows(share));
  const splats = new Float32Array(4 * WIDTH * rows(TEXELS * total));
  const changes = new Int8Array(4 * WIDTH * rows(change)), bands = new Int8Array(4 * WIDTH * rows(band));
  for (const e of entities) {
    for (let i = 0, o = 4 * TEXELS * e.first; i < e.count; i++, o += 4 * TEXELS) {
      splats.set(e.position.subarray(3 * i, 3 * i + 3), o); splats[o + 3] = e.opacity[i];
      splats.set(e.quat.subarray(4 * i, 4 * i + 4), o + 4);
      splats.set(e.scale.subarray(3 * i, 3 * i + 3), o + 8); splats[o + 11] = e.share;
      for (let c = 0; c < 3; c++) splats[o + 12 + c] = 0.5 + C0 * e.dc[3 * i + c];
      for (let c = 0; c < 4; c++) splats[o + 16 + c] = e.joint + (e.joints ? e.joints[4 * i + c] : 0);
      if (e.weights) splats.set(e.weights.subarray(4 * i, 4 * i + 4), o + 20); else splats[o + 20] = 1;
    }
    const spread = (into, o, step, part, channels) => {
      if (part) for (let c = 0; c < channels; c++) for (let i = 0; i < e.count; i++) into[o + step * i + c] = e.bytes[part.offset + c * e.count + i];
    };
    e.peak = e.modes.map((mode, k) => {
      const o = 4 * (e.change + CHANGE * e.count * k), step = 4 * CHANGE, part = e.changes[k] || {};
      const peak = mode.reduce((most, x) => Math.max(most, Math.abs(x)), 1e-9);
      for (let i = 0; i < e.count; i++) for (let c = 0; c < 3; c++) changes[o + step * i + c] = Math.round(127 * mode[3 * i + c] / peak);
      spread(changes, o + 3, step, part.OPACITY, 1); spread(changes, o + 4, step, part.ROTATION, 4);
      spread(changes, o + 8, step, part.COLOR, 3); spread(changes, o + 12, step, part.SCALE, 3);
      return peak;
    });
    spread(bands, 4 * e.band, 4 * e.across, e.sh, 3 * ((e.degree + 1) ** 2 - 1));
  }
  return { splats, changes, bands };
}

// ---- drawing --------------------------------------------------------------------------------
// once for every splat, in the order of drawing: where its ellipse is, how large, and of which colour
const PLACED = `#version 300 es
precision highp float; precision highp int;
uniform highp sampler2D splats, bones, shares, changes, bands;
uniform mat3 turn; uniform vec3 shift, eye; uniform vec2 focal, center, size; uniform float blur; uniform bool antialiased;
in uint index;
out vec4 spot, tint; out vec2 shape; // middle and long axis, colour, half the short axis and how many sigmas
vec4 get(sampler2D from, int i) { return texelFetch(from, ivec2(i % ${WIDTH}, i / ${WIDTH}), 0); }
vec3 light(int first, int degree, float step, vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  float Y[16] = float[16](0.0, -0.4886025 * y, 0.4886025 * z, -0.4886025 * x, 1.0925484 * x * y, -1.0925484 * y * z,
    0.3153916 * (2.0 * zz - xx - yy), -1.0925484 * x * z, 0.5462742 * (xx - yy), -0.5900436 * y * (3.0 * xx - yy),
    2.8906114 * x * y * z, -0.4570458 * y * (4.0 * zz - xx - yy), 0.3731763 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
    -0.4570458 * x * (4.0 * zz - xx - yy), 1.4453057 * z * (xx - yy), -0.5900436 * x * (xx - 3.0 * yy));
  vec3 sum = vec3(0.0);
  int count = 3 * (degree + 1) * (degree + 1) - 3;
  for (int i = 0; i < count; i += 4) {
    vec4 four = get(bands, first + i / 4);
    for (int c = 0; c < 4; c++) if (i + c < count) sum[(i + c) % 3] += four[c] * Y[1 + (i + c) / 3];
  }
  return step * sum;
}
void main() {
  int n = int(index), at = n * ${TEXELS};
  vec4 place = get(splats, at), q = get(splats, at + 1), wide = get(splats, at + 2), shade = get(splats, at + 3);
  vec4 joint = get(splats, at + 4), weight = get(splats, at + 5);
  int row = int(wide.w);
  vec4 about = get(shares, row), more = get(shares, row + 1);
  spot = tint = vec4(0.0); shape = vec2(0.0);
  int modes = int(about.y), count = int(more.y), mine = n - int(more.w), first = int(about.w) + ${CHANGE} * mine;
  float opacity = place.w;
  vec3 grown = vec3(0.0);
  for (int k = 0; k < modes; k++, first += ${CHANGE} * count) {
    vec4 w = get(shares, row + 2 + 2 * k);
    float wide_ = get(shares, row + 3 + 2 * k).x;
    vec4 moved = get(changes, first);
    place.xyz += w.x * moved.xyz;
    opacity += w.w * moved.w;
    if (w.y != 0.0) q += w.y * get(changes, first + 1);
    if (w.z != 0.0) shade.rgb += w.z * get(changes, first + 2).rgb;
    if (wide_ != 0.0) grown += wide_ * get(changes, first + 3).xyz;
  }
  vec4 r0 = vec4(0.0), r1 = vec4(0.0), r2 = vec4(0.0), by = vec4(0.0);
  for (int c = 0; c < 4; c++) {
    if (weight[c] == 0.0) continue;
    int j = 4 * int(joint[c]);
    r0 += weight[c] * get(bones, j); r1 += weight[c] * get(bones, j + 1); r2 += weight[c] * get(bones, j + 2); by += weight[c] * get(bones, j + 3);
  }
  vec4 whole = vec4(place.xyz, 1.0);
  vec3 world = vec3(dot(r0, whole), dot(r1, whole), dot(r2, whole)), p = turn * world + shift;
  if (p.z < 0.05) return;
  vec2 pixel = focal * p.xy / p.z + center;
  vec3 s = wide.xyz * about.x * exp(grown);
  if (about.z > 0.0) shade.rgb += light(int(more.x) + mine * ((3 * int((about.z + 1.0) * (about.z + 1.0)) - 3 + 3) / 4), int(about.z), more.z, normalize(world - eye));
  by = normalize(by); q = normalize(q);
  q = vec4(by.w * q.xyz + q.w * by.xyz + cross(by.xyz, q.xyz), by.w * q.w - dot(by.xyz, q.xyz));
  float w = q.w, x = q.x, y = q.y, z = q.z;
  mat3 R = mat3(1.0 - 2.0 * (y*y + z*z), 2.0 * (x*y + w*z), 2.0 * (x*z - w*y),
                2.0 * (x*y - w*z), 1.0 - 2.0 * (x*x + z*z), 2.0 * (y*z + w*x),
                2.0 * (x*z + w*y), 2.0 * (y*z - w*x), 1.0 - 2.0 * (x*x + y*y));
  mat3 M = turn * R * mat3(s.x, 0, 0, 0, s.y, 0, 0, 0, s.z);
  vec2 half_ = 0.5 * size / focal;
  vec2 t = clamp(p.xy / p.z, -(center / focal + 0.3 * half_), (size - center) / focal + 0.3 * half_);
  vec3 jx = vec3(focal.x / p.z, 0.0, -focal.x * t.x / p.z);
  vec3 jy = vec3(0.0, focal.y / p.z, -focal.y * t.y / p.z);
  vec3 m0 = transpose(M) * jx, m1 = transpose(M) * jy;
  float a = dot(m0, m0) + blur, b = dot(m0, m1), c = dot(m1, m1) + blur;
  opacity = clamp(opacity, 0.0, 1.0);
  if (antialiased) opacity *= length(cross(m0, m1)) / sqrt(max(a * c - b * b, 1e-12));
  float mid = 0.5 * (a + c), reach = sqrt(max(0.25 * (a - c) * (a - c) + b * b, 1e-12));
  float big = mid + reach, small = max(mid - reach, 1e-4);
  vec2 axis = abs(b) > 1e-6 ? normalize(vec2(b, big - a)) : (a >= c ? vec2(1, 0) : vec2(0, 1));
  float cut = sqrt(max(2.0 * log(255.0 * opacity), 0.0));
  if (cut <= 0.0) return;
  if (pixel.x + cut * sqrt(big) < 0.0 || pixel.x - cut * sqrt(big) > size.x ||
      pixel.y + cut * sqrt(big) < 0.0 || pixel.y - cut * sqrt(big) > size.y) return;
  spot = vec4(pixel, axis * sqrt(big)); tint = vec4(max(shade.rgb, 0.0), opacity); shape = vec2(sqrt(small), cut);
}`;
const NOTHING = `#version 300 es
precision highp float; void main() {}`;
const VERTEX = `#version 300 es
precision highp float;
uniform vec2 size;
in vec4 spot, tint; in vec2 shape;
out vec4 color; out vec2 offset;
void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  if (shape.y <= 0.0) return;
  color = tint;
  offset = shape.y * (vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0);
  vec2 at = spot.xy + offset.x * spot.zw + offset.y * shape.x * normalize(vec2(-spot.w, spot.z));
  gl_Position = vec4(2.0 * at.x / size.x - 1.0, 1.0 - 2.0 * at.y / size.y, 0.0, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec4 color; in vec2 offset; out vec4 pixel;
void main() {
  float alpha = min(0.999, color.a * exp(-0.5 * dot(offset, offset)));
  if (alpha < 1.0 / 255.0) discard;
  pixel = vec4(color.rgb * alpha, alpha);
}`;

const canvas = $("canvas");
let gl = null, placing, program, whole, uniforms = {}, textures = {}, order, orderBuffer, spots, sources, drawn;
function built(vertex, fragment, captured) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  if (captured) gl.transformFeedbackVaryings(made, captured, gl.INTERLEAVED_ATTRIBS);
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

function prepare() {
  if (!gl) {
    gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL2");
    placing = built(PLACED, NOTHING, ["spot", "tint", "shape"]); program = built(VERTEX, FRAGMENT);
    for (const name of ["turn", "shift", "eye", "focal", "center", "size", "blur", "antialiased"]) uniforms[name] = gl.getUniformLocation(placing, name);
    whole = gl.getUniformLocation(program, "size");
    orderBuffer = gl.createBuffer(); spots = gl.createBuffer(); sources = gl.createVertexArray(); drawn = gl.createVertexArray();
  }
  gl.useProgram(placing);
  const { splats, changes, bands } = layout();
  Object.entries({ splats, bones, shares, changes, bands }).forEach(([name, array], unit) => {
    gl.uniform1i(gl.getUniformLocation(placing, name), unit);
    gl.activeTexture(gl.TEXTURE0 + unit);
    if (textures[name]) gl.deleteTexture(textures[name].texture);
    const texture = gl.createTexture(), rows = array.length / 4 / WIDTH;
    textures[name] = { texture, unit, rows };
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
    if (array instanceof Float32Array) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, WIDTH, rows, 0, gl.RGBA, gl.FLOAT, array);
    else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8_SNORM, WIDTH, rows, 0, gl.RGBA, gl.BYTE, array);
  });
  order = new Uint32Array(total);
  depths = new Float32Array(total); bins = new Uint16Array(total);
  const width = 4 * 10; // bytes of a placed splat
  gl.bindVertexArray(drawn);
  gl.bindBuffer(gl.ARRAY_BUFFER, spots);
  gl.bufferData(gl.ARRAY_BUFFER, width * total, gl.DYNAMIC_COPY);
  for (const [name, count, start] of [["spot", 4, 0], ["tint", 4, 16], ["shape", 2, 32]]) {
    const slot = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(slot);
    gl.vertexAttribPointer(slot, count, gl.FLOAT, false, width, start);
    gl.vertexAttribDivisor(slot, 1);
  }
  gl.bindVertexArray(sources);
  gl.bindBuffer(gl.ARRAY_BUFFER, orderBuffer);
  gl.bufferData(gl.ARRAY_BUFFER, order.byteLength, gl.DYNAMIC_DRAW);
  const slot = gl.getAttribLocation(placing, "index");
  gl.enableVertexAttribArray(slot);
  gl.vertexAttribIPointer(slot, 1, gl.UNSIGNED_INT, 0, 0);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
}

function upload() {
  for (const [name, array] of [["bones", bones], ["shares", shares]]) {
    gl.activeTexture(gl.TEXTURE0 + textures[name].unit);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, textures[name].rows, gl.RGBA, gl.FLOAT, array);
  }
}

// far to near, by counting sort over 65536 steps of depth
const BINS = 65536, counts = new Uint32Array(BINS + 1);
let depths = null, bins = null;
function sort(camera) {
  const [x, y, z, t] = camera.pose.slice(8, 12);
  let near = Infinity, far = -Infinity, k = 0;
  for (const e of entities) {
    if (!e.shown) continue;
    const rows = new Float32Array(4 * e.matrices.length); // depth is linear in the position, joint by joint
    e.matrices.forEach((m, j) => { for (let c = 0; c < 4; c++) rows[4 * j + c] = x * m[c] + y * m[4 + c] + z * m[8 + c] + (c === 3 ? t : 0); });
    const modes = e.modes.filter((_, m) => e.weight[m] * e.peak[m] > 1e-5 || e.weight[m] * e.peak[m] < -1e-5);
    const weight = e.weight.filter((w, m) => Math.abs(w * e.peak[m]) > 1e-5);
    for (let i = 0; i < e.count; i++) {
      let a = e.position[3 * i], b = e.position[3 * i + 1], c = e.position[3 * i + 2], depth;
      for (let m = 0; m < modes.length; m++) { const w = weight[m], d = modes[m]; a += w * d[3 * i]; b += w * d[3 * i + 1]; c += w * d[3 * i + 2]; }
      if (e.joints) {
        depth = 0;
        for (let j = 4 * i; j < 4 * i + 4 && e.weights[j] > 0; j++) { const r = 4 * e.joints[j]; depth += e.weights[j] * (rows[r] * a + rows[r + 1] * b + rows[r + 2] * c + rows[r + 3]); }
      } else depth = rows[0] * a + rows[1] * b + rows[2] * c + rows[3];
      depths[k++] = depth;
      if (depth < near) near = depth;
      if (depth > far) far = depth;
    }
  }
  near = Math.max(near, 0.05);
  const scale = (BINS - 1) / Math.max(far - near, 1e-6);
  counts.fill(0);
  for (let i = 0; i < k; i++) { bins[i] = BINS - 1 - Math.max(0, Math.min(BINS - 1, (depths[i] - near) * scale)); counts[bins[i] + 1]++; }
  for (let i = 0; i < BINS; i++) counts[i + 1] += counts[i];
  k = 0;
  for (const e of entities) {
    if (!e.shown) continue;
    for (let i = 0, index = e.first; i < e.count; i++, index++) order[counts[bins[k++]]++] = index;
  }
  gl.bufferSubData(gl.ARRAY_BUFFER, 0, order.subarray(0, k));
  return k;
}

function draw() {
  const ratio = Math.min(window.devicePixelRatio || 1, 2) * (moving() ? Math.ceil(8 * part) / 8 : 1);
  const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const camera = current(width, height);
  const count = sort(camera);
  gl.viewport(0, 0, width, height);
  gl.clearColor(0, 0, 0, 1); gl.clear(gl.COLOR_BUFFER_BIT);
  if (camera.frame) { gl.enable(gl.SCISSOR_TEST); gl.scissor(...camera.frame.map(Math.round)); } // what lies beside it was never seen
  const p = camera.pose;
  gl.useProgram(placing); gl.bindVertexArray(sources);
  gl.uniformMatrix3fv(uniforms.turn, false, [p[0], p[4], p[8], p[1], p[5], p[9], p[2], p[6], p[10]]);
  gl.uniform3f(uniforms.shift, p[3], p[7], p[11]);
  gl.uniform3f(uniforms.eye, ...[0, 1, 2].map((j) => -(p[j] * p[3] + p[4 + j] * p[7] + p[8 + j] * p[11])));
  gl.uniform2f(uniforms.focal, camera.K[0], camera.K[1]);
  gl.uniform2f(uniforms.center, camera.K[2], camera.K[3]);
  gl.uniform2f(uniforms.size, width, height);
  gl.uniform1f(uniforms.blur, motion.lowPass);
  gl.uniform1i(uniforms.antialiased, motion.antialiased ? 1 : 0);
  gl.enable(gl.RASTERIZER_DISCARD);
  gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, spots);
  gl.beginTransformFeedback(gl.POINTS);
  gl.drawArrays(gl.POINTS, 0, count);
  gl.endTransformFeedback();
  gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
  gl.disable(gl.RASTERIZER_DISCARD);
  gl.useProgram(program); gl.bindVertexArray(drawn);
  gl.uniform2f(whole, width, height);
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  gl.disable(gl.SCISSOR_TEST);
}

// ---- cameras --------------------------------------------------------------------------------
const sub = (a, b) => a.map((x, i) => x - b[i]), add = (a, b) => a.map((x, i) => x + b[i]), mul = (a, s) => a.map((x) => x * s);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => mul(a, 1 / (Math.hypot(...a) || 1));
const UP = [0, 1, 0];

let frame = 0, playing = false, ofVideo = true;
let eye, target, focus, distance = 3; // of the free camera; focus: focal length in parts of the canvas's height

// the camera of the video; glTF's looks along -z with y up
function videoCamera() {
  const { m } = placed(doc.nodes[motion.camera], new Map());
  const a = Math.min(Math.floor(frame), motion.intrinsics.length - 1), b = Math.min(a + 1, motion.intrinsics.length - 1), r = Math.min(1, frame - a);
  const K = motion.intrinsics[a].map((x, k) => x * (1 - r) + motion.intrinsics[b][k] * r);
  return { eye: [m[3], m[7], m[11]], forward: [-m[2], -m[6], -m[10]], down: [-m[1], -m[5], -m[9]], K, size: motion.size };
}

function posed(at, forward, down) {
  const right = unit(cross(down, forward)), low = cross(forward, right);
  return [...right, -dot(right, at), ...low, -dot(low, at), ...forward, -dot(forward, at)];
}

function current(width, height) {
  const v = videoCamera();
  if (ofVideo) {
    const scale = Math.min(width / v.size[0], height / v.size[1]);
    const left = (width - scale * v.size[0]) / 2, top = (height - scale * v.size[1]) / 2;
    const frame = [left, top, scale * v.size[0], scale * v.size[1]];
    return { pose: posed(v.eye, v.forward, v.down), frame, K: [v.K[0] * scale, v.K[1] * scale, v.K[2] * scale + left, v.K[3] * scale + top] };
  }
  const f = focus * height;
  return { pose: posed(eye, unit(sub(target, eye)), mul(UP, -1)), K: [f, f, width / 2, height / 2] };
}

function leaveVideo() {
  if (!ofVideo) return;
  const v = videoCamera();
  eye = v.eye; target = add(v.eye, mul(v.forward, distance));
  focus = v.K[1] * Math.min(canvas.width / v.size[0], canvas.height / v.size[1]) / canvas.height;
  ofVideo = false; controls();
}

function orbit(dx, dy) {
  leaveVideo();
  const away = sub(eye, target), distance = Math.hypot(...away);
  const around = (v, axis, angle) => add(add(mul(v, Math.cos(angle)), mul(cross(axis, v), Math.sin(angle))), mul(axis, dot(axis, v) * (1 - Math.cos(angle))));
  let turned = around(away, UP, -dx);
  const lifted = around(turned, unit(cross(turned, UP)), -dy);
  if (Math.abs(dot(unit(lifted), UP)) < 0.985) turned = lifted;
  eye = add(target, mul(unit(turned), distance));
}

function pan(dx, dy) {
  leaveVideo();
  const distance = Math.hypot(...sub(eye, target)), forward = unit(sub(target, eye));
  const right = unit(cross(forward, UP)), up = cross(right, forward);
  const step = add(mul(right, -dx * distance / focus), mul(up, dy * distance / focus));
  eye = add(eye, step); target = add(target, step);
}

function zoom(factor) {
  leaveVideo();
  const away = sub(eye, target);
  eye = add(target, mul(away, Math.min(Math.max(factor, 0.1), 10)));
  if (Math.hypot(...sub(eye, target)) < 0.05) eye = add(target, mul(unit(away), 0.05));
}

// ---- time and controls ----------------------------------------------------------------------
let dirty = true, stale = true, before = 0;
let LAST = 0, rate = 25;
let part = 1, drew = false; // pixels a side, in parts of the screen's: fewer while what moves comes late
const moving = () => playing || canvas.classList.contains("drag");

function seek(value) { frame = Math.min(Math.max(value, 0), LAST); stale = dirty = true; controls(); }

function controls() {
  $("time").value = frame;
  $("frame").textContent = `${frame.toFixed(1)} / ${LAST}`;
  $("play").textContent = playing ? "❚❚" : "▶";
  $("video").classList.toggle("on", ofVideo);
  dirty = true;
}

function tick(now) {
  if (playing && LAST > 0) {
    const next = frame + (now - before) / 1000 * rate * Number($("speed").value);
    frame = next > LAST ? next % (LAST + 1) : next;
    frame = Math.min(frame, LAST);
    stale = true; controls();
  }
  if (drew && moving()) part = Math.min(1, Math.max(0.25, part * (now - before > 40 ? 0.8 : now - before < 22 ? 1.02 : 1)));
  before = now; drew = stale || dirty;
  const began = performance.now();
  if (stale) { place(); upload(); stale = false; dirty = true; }
  if (dirty) { dirty = false; draw(); window.drawn = (window.drawn || 0) + 1; window.spent = (window.spent || 0) + performance.now() - began; }
  requestAnimationFrame(tick);
}

// name what was read; the header of a page, if this file is its own, says more
function show(title, lines) {
  LAST = moments.length - 1;
  rate = LAST > 0 ? LAST / (moments[LAST] - moments[0]) : 25;
  frame = 0; ofVideo = true; playing = false;
  place(); upload();
  const subject = entities.find((e) => e.joints) || entities.find((e) => !e.still) || entities[0];
  if (subject) {
    const m = subject.matrices[0], v = videoCamera(), middle = [0, 0, 0];
    for (let i = 0; i < subject.count; i++) for (let c = 0; c < 3; c++) middle[c] += subject.position[3 * i + c] / subject.count;
    distance = Math.max(0.3, dot(sub([0, 1, 2].map((r) => m[4 * r] * middle[0] + m[4 * r + 1] * middle[1] + m[4 * r + 2] * middle[2] + m[4 * r + 3]), v.eye), v.forward));
  }
  document.title = title;
  $("title").textContent = title;
  $("time").max = LAST;
  $("about").replaceChildren(); $("entities").replaceChildren();
  for (const line of [...lines, "Drag: orbit. Right button or shift: move. Wheel: nearer. Space: play. Another file of hoigs export --format gltf-4d: drop it here. Made with hoigs."]) { const p = document.createElement("p"); p.textContent = line; $("about").append(p); }
  for (const e of entities) {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox"; box.checked = true; box.id = `show-${e.name}`;
    box.onchange = () => { e.shown = box.checked; dirty = true; };
    label.append(box, ` ${e.name}`); $("entities").append(label);
  }
  $("message").style.display = "none";
  controls();
}

function wire() {
  window.ondragover = (event) => event.preventDefault();
  window.ondrop = async (event) => {
    event.preventDefault();
    const file = event.dataTransfer.files[0];
    try { await open(await file.arrayBuffer()); prepare(); show(file.name, []); } catch (error) { fail(`${file.name} cannot be played: ${error.message}`); }
  };
  $("play").onclick = () => { playing = !playing; controls(); };
  $("back").onclick = () => { playing = false; seek(Math.ceil(frame) - 1); };
  $("next").onclick = () => { playing = false; seek(Math.floor(frame) + 1); };
  $("time").oninput = (e) => { playing = false; seek(Number(e.target.value)); };
  $("video").onclick = () => { if (ofVideo) leaveVideo(); else { ofVideo = true; controls(); } };
  $("info").onclick = () => { $("about").hidden = !$("about").hidden; };
  window.onresize = () => { dirty = true; };
  const fingers = new Map();
  let apart = 0;
  canvas.oncontextmenu = (e) => e.preventDefault();
  canvas.onpointerdown = (e) => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); canvas.classList.add("drag"); apart = 0; };
  canvas.onpointerup = canvas.onpointercancel = (e) => { fingers.delete(e.pointerId); canvas.classList.remove("drag"); apart = 0; dirty = true; };
  canvas.onpointermove = (e) => {
    const old = fingers.get(e.pointerId);
    if (!old) return;
    const dx = (e.clientX - old[0]) / canvas.clientHeight, dy = (e.clientY - old[1]) / canvas.clientHeight;
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (fingers.size === 2) {
      const [a, b] = [...fingers.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (apart) zoom(apart / now);
      apart = now;
    } else if (e.buttons & 2 || e.shiftKey) pan(dx, dy);
    else orbit(dx * 3, dy * 3);
    dirty = true;
  };
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(e.deltaY * 0.001)); dirty = true; }, { passive: false });
  window.onkeydown = (e) => {
    if (e.key === " ") { e.preventDefault(); $("play").onclick(); }
    if (e.key === "ArrowLeft") $("back").onclick();
    if (e.key === "ArrowRight") $("next").onclick();
    if (e.key === "v") $("video").onclick();
  };
}

(async () => {
  try {
    const text = atob($("data").textContent.trim()), header = JSON.parse($("header").textContent);
    $("data").textContent = "";
    await open(await inflated(Uint8Array.from(text, (c) => c.charCodeAt(0)), "gzip"));
    prepare(); wire(); show(header.title, header.leftOut);
    requestAnimationFrame((now) => { before = now; tick(now); });
  } catch (error) { fail(`This file cannot be played here: ${error.message}`); throw error; }
})();
})();

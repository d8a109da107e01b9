"use strict";
// A player of moving 3D Gaussians: unpack, place at a time, sort by depth, draw as quads (WebGL2).
// Drawing follows Zwicker et al. 2002 (EWA) and Kerbl et al. 2023, as hoigs does; colours do not
// depend on the direction.
(() => {
const $ = (id) => document.getElementById(id);
const H = JSON.parse($("header").textContent);
const ROW = 256;      // splats in a row of the texture; entities begin at a row
const TEXELS = 4;     // of a splat: position and opacity, quaternion, scales, colour

const fail = (text) => { $("message").textContent = text; $("message").hidden = false; $("message").style.display = ""; };

// ---- unpacking ------------------------------------------------------------------------------
async function unpack() {
  const text = atob($("data").textContent.trim());
  const zipped = Uint8Array.from(text, (c) => c.charCodeAt(0));
  $("data").textContent = "";
  const stream = new Blob([zipped]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  let start = 0;
  for (const track of H.tracks) { decode(track, bytes.subarray(start, start + track.bytes)); start += track.bytes; }
}

// codes come key by key as differences, channel by channel; they are summed up here
function decode(track, bytes) {
  const n = track.count, k = track.keys;
  const sums = (channels, low, high, mask) => {
    const out = new Uint16Array(k * channels * n);
    for (let i = 0, before = -channels * n; i < out.length; i++, before++) {
      let code = low[i] + (high ? high[i] << 8 : 0);
      if (before >= 0) code += out[before];
      out[i] = code & mask;
    }
    return out;
  };
  let at = 0;
  const take = (count) => bytes.subarray(at, at += count);
  const low = take(k * 3 * n), high = take(k * 3 * n);
  track.means = sums(3, low, high, 65535);
  track.scales = sums(3, take(k * 3 * n), null, 255);
  track.quats = sums(4, take(k * 4 * n), null, 255);
  track.rgba = sums(4, take(k * 4 * n), null, 255);
}

// ---- placing at a time ----------------------------------------------------------------------
let data, rows = 0, total = 0, centers;
function allocate() {
  for (const track of H.tracks) {
    track.row = rows;
    rows += Math.ceil(track.count / ROW);
    track.shown = true;
    total += track.count;
  }
  data = new Float32Array(Math.max(rows, 1) * ROW * TEXELS * 4);
  for (const track of H.tracks) place(track, 0);
}

// the keys before and after a frame, and the share of the way between them
function keysAt(track, frame) {
  if (track.keys === 1) return [0, 0, 0];
  const stride = H.stride;
  const a = Math.min(Math.floor(frame / stride), track.keys - 2);
  const from = a * stride, to = Math.min((a + 1) * stride, H.frames - 1);
  return [a, a + 1, Math.min(1, (frame - from) / Math.max(to - from, 1e-9))];
}

const signed = (code) => (code > 127 ? code - 256 : code) / 127;

function place(track, frame) {
  const n = track.count, [a, b, r] = keysAt(track, frame);
  const step = [0, 1, 2].map((c) => (track.high[c] - track.low[c]) / 65535);
  const grow = [0, 1, 2].map((c) => (track.large[c] - track.small[c]) / 255);
  const pose = track.poses ? poseAt(track.poses, frame) : null;
  const out = data.subarray(track.row * ROW * TEXELS * 4);
  const q = [0, 0, 0, 0];
  for (let i = 0, o = 0; i < n; i++, o += 16) {
    for (let c = 0; c < 3; c++) {
      const x = track.means[(a * 3 + c) * n + i], y = track.means[(b * 3 + c) * n + i];
      out[o + c] = track.low[c] + (x + (y - x) * r) * step[c];
      const s = track.scales[(a * 3 + c) * n + i], t = track.scales[(b * 3 + c) * n + i];
      out[o + 8 + c] = Math.exp(track.small[c] + (s + (t - s) * r) * grow[c]);
    }
    let sign = 0;
    for (let c = 0; c < 4; c++) sign += signed(track.quats[(a * 4 + c) * n + i]) * signed(track.quats[(b * 4 + c) * n + i]);
    sign = sign < 0 ? -1 : 1;
    for (let c = 0; c < 4; c++) {
      const x = signed(track.quats[(a * 4 + c) * n + i]), y = sign * signed(track.quats[(b * 4 + c) * n + i]);
      q[c] = x + (y - x) * r;
      const u = track.rgba[(a * 4 + c) * n + i], v = track.rgba[(b * 4 + c) * n + i];
      out[o + (c < 3 ? 12 + c : 3)] = ((u + (v - u) * r) / 255) * (c < 3 ? track.bright : 1);
    }
    if (pose) {
      const p = rotate(pose.q, out[o], out[o + 1], out[o + 2]);
      out[o] = p[0] + pose.t[0]; out[o + 1] = p[1] + pose.t[1]; out[o + 2] = p[2] + pose.t[2];
      multiply(pose.q, q, q);
    }
    const length = Math.hypot(q[0], q[1], q[2], q[3]) || 1;
    for (let c = 0; c < 4; c++) out[o + 4 + c] = q[c] / length;
  }
  if (gl) upload(track);
}

function poseAt(poses, frame) {
  const i = Math.min(Math.floor(frame), poses.length - 1), j = Math.min(i + 1, poses.length - 1), r = frame - i;
  const a = poses[i], b = poses[j];
  const sign = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0 ? -1 : 1;
  const q = [0, 1, 2, 3].map((c) => a[c] * (1 - r) + sign * b[c] * r);
  const length = Math.hypot(...q);
  return { q: q.map((x) => x / length), t: [4, 5, 6].map((c) => a[c] * (1 - r) + b[c] * r) };
}

function rotate(q, x, y, z) {
  const [w, a, b, c] = q;
  const u = 2 * (b * z - c * y), v = 2 * (c * x - a * z), s = 2 * (a * y - b * x);
  return [x + w * u + b * s - c * v, y + w * v + c * u - a * s, z + w * s + a * v - b * u];
}

function multiply(p, q, out) {
  const [a, b, c, d] = p, [e, f, g, h] = q;
  out[0] = a * e - b * f - c * g - d * h; out[1] = a * f + b * e + c * h - d * g;
  out[2] = a * g - b * h + c * e + d * f; out[3] = a * h + b * g - c * f + d * e;
}

// ---- drawing --------------------------------------------------------------------------------
const VERTEX = `#version 300 es
precision highp float; precision highp int;
uniform highp sampler2D splats;
uniform mat3 turn; uniform vec3 shift; uniform vec2 focal, center, size; uniform float blur; uniform bool antialiased;
in uint index;
out vec4 color; out vec2 offset;
void main() {
  ivec2 at = ivec2(int(index % ${ROW}u) * ${TEXELS}, int(index / ${ROW}u));
  vec4 place = texelFetch(splats, at, 0);
  vec3 p = turn * place.xyz + shift;
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  if (p.z < 0.05) return;
  vec2 pixel = focal * p.xy / p.z + center;
  vec4 q = texelFetch(splats, at + ivec2(1, 0), 0);
  vec3 s = texelFetch(splats, at + ivec2(2, 0), 0).xyz;
  float w = q.x, x = q.y, y = q.z, z = q.w;
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
  float opacity = place.w;
  if (antialiased) opacity *= length(cross(m0, m1)) / sqrt(max(a * c - b * b, 1e-12));
  float mid = 0.5 * (a + c), reach = sqrt(max(0.25 * (a - c) * (a - c) + b * b, 1e-12));
  float big = mid + reach, small = max(mid - reach, 1e-4);
  vec2 axis = abs(b) > 1e-6 ? normalize(vec2(b, big - a)) : (a >= c ? vec2(1, 0) : vec2(0, 1));
  float cut = sqrt(max(2.0 * log(255.0 * opacity), 0.0));
  if (cut <= 0.0) return;
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  offset = corner * cut;
  vec2 at2 = pixel + axis * offset.x * sqrt(big) + vec2(-axis.y, axis.x) * offset.y * sqrt(small);
  if (pixel.x + cut * sqrt(big) < 0.0 || pixel.x - cut * sqrt(big) > size.x ||
      pixel.y + cut * sqrt(big) < 0.0 || pixel.y - cut * sqrt(big) > size.y) return;
  color = vec4(texelFetch(splats, at + ivec2(3, 0), 0).rgb, opacity);
  gl_Position = vec4(2.0 * at2.x / size.x - 1.0, 1.0 - 2.0 * at2.y / size.y, 0.0, 1.0);
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
let gl = null, uniforms = {}, texture, order, orderBuffer;
function prepare() {
  const made = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
  if (!made) throw new Error("this browser has no WebGL2");
  const program = made.createProgram();
  for (const [kind, source] of [[made.VERTEX_SHADER, VERTEX], [made.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = made.createShader(kind);
    made.shaderSource(shader, source); made.compileShader(shader);
    if (!made.getShaderParameter(shader, made.COMPILE_STATUS)) throw new Error(made.getShaderInfoLog(shader));
    made.attachShader(program, shader);
  }
  made.linkProgram(program);
  if (!made.getProgramParameter(program, made.LINK_STATUS)) throw new Error(made.getProgramInfoLog(program));
  made.useProgram(program);
  for (const name of ["turn", "shift", "focal", "center", "size", "blur", "antialiased"]) uniforms[name] = made.getUniformLocation(program, name);
  texture = made.createTexture();
  made.bindTexture(made.TEXTURE_2D, texture);
  for (const key of [made.TEXTURE_MIN_FILTER, made.TEXTURE_MAG_FILTER]) made.texParameteri(made.TEXTURE_2D, key, made.NEAREST);
  made.texImage2D(made.TEXTURE_2D, 0, made.RGBA32F, ROW * TEXELS, Math.max(rows, 1), 0, made.RGBA, made.FLOAT, data);
  order = new Uint32Array(total);
  orderBuffer = made.createBuffer();
  made.bindBuffer(made.ARRAY_BUFFER, orderBuffer);
  made.bufferData(made.ARRAY_BUFFER, order.byteLength, made.DYNAMIC_DRAW);
  const slot = made.getAttribLocation(program, "index");
  made.enableVertexAttribArray(slot);
  made.vertexAttribIPointer(slot, 1, made.UNSIGNED_INT, 0, 0);
  made.vertexAttribDivisor(slot, 1);
  made.enable(made.BLEND);
  made.blendFunc(made.ONE, made.ONE_MINUS_SRC_ALPHA);
  gl = made;
}

function upload(track) {
  const count = Math.ceil(track.count / ROW);
  if (!count) return;
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, track.row, ROW * TEXELS, count, gl.RGBA, gl.FLOAT,
    data.subarray(track.row * ROW * TEXELS * 4, (track.row + count) * ROW * TEXELS * 4));
}

// far to near, by counting sort over 65536 steps of depth
const BINS = 65536, counts = new Uint32Array(BINS + 1);
let depths = null, bins = null;
function sort(camera) {
  if (!depths || depths.length < total) { depths = new Float32Array(total); bins = new Uint16Array(total); }
  const [x, y, z, t] = camera.pose.slice(8, 12);
  let near = Infinity, far = -Infinity, k = 0;
  for (const track of H.tracks) {
    if (!track.shown) continue;
    for (let i = 0, o = track.row * ROW * 16; i < track.count; i++, o += 16) {
      const depth = x * data[o] + y * data[o + 1] + z * data[o + 2] + t;
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
  for (const track of H.tracks) {
    if (!track.shown) continue;
    for (let i = 0, index = track.row * ROW; i < track.count; i++, index++) order[counts[bins[k++]]++] = index;
  }
  gl.bufferSubData(gl.ARRAY_BUFFER, 0, order.subarray(0, k));
  return k;
}

function draw() {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const camera = current(width, height);
  const count = sort(camera);
  gl.viewport(0, 0, width, height);
  gl.clearColor(0, 0, 0, 1); gl.clear(gl.COLOR_BUFFER_BIT);
  const p = camera.pose;
  gl.uniformMatrix3fv(uniforms.turn, false, [p[0], p[4], p[8], p[1], p[5], p[9], p[2], p[6], p[10]]);
  gl.uniform3f(uniforms.shift, p[3], p[7], p[11]);
  gl.uniform2f(uniforms.focal, camera.K[0], camera.K[1]);
  gl.uniform2f(uniforms.center, camera.K[2], camera.K[3]);
  gl.uniform2f(uniforms.size, width, height);
  gl.uniform1f(uniforms.blur, H.lowPass);
  gl.uniform1i(uniforms.antialiased, H.antialiased ? 1 : 0);
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
}

// ---- cameras --------------------------------------------------------------------------------
const sub = (a, b) => a.map((x, i) => x - b[i]), add = (a, b) => a.map((x, i) => x + b[i]), mul = (a, s) => a.map((x) => x * s);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => mul(a, 1 / (Math.hypot(...a) || 1));
const UP = unit(H.up);

let frame = 0, playing = false, ofVideo = true;
let eye, target, focus; // of the free camera; focus: focal length in parts of the canvas's height

function videoCamera() {
  let i = 0;
  while (i < H.cameras.length - 2 && H.cameras[i + 1].frame <= frame) i++;
  const a = H.cameras[i], b = H.cameras[Math.min(i + 1, H.cameras.length - 1)];
  const r = b.frame > a.frame ? Math.min(1, Math.max(0, (frame - a.frame) / (b.frame - a.frame))) : 0;
  const axis = (c, k) => [0, 1, 2].map((j) => c.pose[4 * k + j]);
  const place = (c) => [0, 1, 2].map((j) => -(axis(c, 0)[j] * c.pose[3] + axis(c, 1)[j] * c.pose[7] + axis(c, 2)[j] * c.pose[11]));
  const forward = unit(add(mul(axis(a, 2), 1 - r), mul(axis(b, 2), r)));
  const down = add(mul(axis(a, 1), 1 - r), mul(axis(b, 1), r));
  return { eye: add(mul(place(a), 1 - r), mul(place(b), r)), forward, down, K: a.K.map((x, k) => x * (1 - r) + b.K[k] * r), size: a.size };
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
    return { pose: posed(v.eye, v.forward, v.down), K: [v.K[0] * scale, v.K[1] * scale, v.K[2] * scale + left, v.K[3] * scale + top] };
  }
  const f = focus * height;
  return { pose: posed(eye, unit(sub(target, eye)), mul(UP, -1)), K: [f, f, width / 2, height / 2] };
}

function leaveVideo() {
  if (!ofVideo) return;
  const v = videoCamera();
  eye = v.eye; target = add(v.eye, mul(v.forward, H.distance));
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
const LAST = Math.max(H.frames - 1, 0);

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
    const next = frame + (now - before) / 1000 * H.fps * Number($("speed").value);
    frame = next > LAST ? next % (LAST + 1) : next;
    frame = Math.min(frame, LAST);
    stale = true; controls();
  }
  before = now;
  if (stale) { for (const track of H.tracks) if (track.motion !== "static") place(track, frame); stale = false; dirty = true; }
  if (dirty) { dirty = false; draw(); window.drawn = (window.drawn || 0) + 1; }
  requestAnimationFrame(tick);
}

function wire() {
  document.title = H.title;
  $("title").textContent = H.title;
  $("time").max = LAST;
  $("about").innerHTML = "";
  const lines = [...H.leftOut, "Drag: orbit. Right button or shift: move. Wheel: nearer. Space: play. Made with hoigs."];
  for (const line of lines) { const p = document.createElement("p"); p.textContent = line; $("about").append(p); }
  for (const track of H.tracks) {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox"; box.checked = true; box.id = `show-${track.name}`;
    box.onchange = () => { track.shown = box.checked; dirty = true; };
    label.append(box, ` ${track.name}`); $("entities").append(label);
  }
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
  canvas.onpointerup = canvas.onpointercancel = (e) => { fingers.delete(e.pointerId); canvas.classList.remove("drag"); apart = 0; };
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
    await unpack();
    allocate(); prepare(); wire(); controls();
    $("message").style.display = "none";
    requestAnimationFrame((now) => { before = now; tick(now); });
  } catch (error) { fail(`This file cannot be played here: ${error.message}`); throw error; }
})();
})();

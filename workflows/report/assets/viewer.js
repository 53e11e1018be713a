"use strict";
// Bodies that turn, and sliders that move them. Data: see workflows/report/scene (scene.py, pack.py, sliders.py).

// --- arrays --------------------------------------------------------------------------------------------------------
async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function unpack(told, bytes) {
  let at = 0;
  return told.map(({ n, m, step, planes, missing }) => {
    const count = n * m, whole = step === 1;
    const out = whole ? new Int32Array(count) : new Float32Array(count);
    for (let j = 0; j < m; j++) {
      for (let i = 0, sum = 0; i < n; i++) {
        let z = 0;
        for (let k = planes - 1, p = at + k * count + j * n + i; k >= 0; k--, p -= count) z = z * 256 + bytes[p];
        sum += z % 2 ? -(z + 1) / 2 : z / 2;
        out[i * m + j] = whole ? sum : sum * step;
      }
    }
    at += planes * count;
    if (missing) for (const i of missing) for (let j = 0; j < m; j++) out[i * m + j] = NaN;
    return out;
  });
}

// --- numbers in words, as forward/readable.py writes them ----------------------------------------------------
const SIZES = {
  m: [[1, "m"], [1e-2, "cm"], [1e-3, "mm"], [1e-6, "µm"], [1e-9, "nm"]],
  Pa: [[1e9, "GPa"], [1e6, "MPa"], [1e3, "kPa"], [1, "Pa"], [1e-3, "mPa"]],
  N: [[1e3, "kN"], [1, "N"], [1e-3, "mN"], [1e-6, "µN"]],
  J: [[1e3, "kJ"], [1, "J"], [1e-3, "mJ"], [1e-6, "µJ"], [1e-9, "nJ"]],
  "m³": [[1, "m³"], [1e-6, "cm³"], [1e-9, "mm³"]],
};
function fitting(value, unit) {
  const sizes = SIZES[unit];
  if (!sizes || !value || !isFinite(value)) return [1, unit];
  return sizes.find(([one]) => Math.abs(value) >= one * (1 - 1e-12)) || sizes[sizes.length - 1];
}
function digits(value, count = 4) {
  if (!isFinite(value)) return "–";
  if (value === 0) return "0";
  const power = Math.floor(Math.log10(Math.abs(value)));
  if (power < -4 || power > 6) return value.toExponential(count - 1).replace("-", "−").replace(/e(.*)/, " × 10^$1").replace("+", "");
  return value.toFixed(Math.max(0, count - 1 - power)).replace("-", "−");
}
// A value to the place of its error: that of its second digit from 10 to 35, else of its first.
function rounded(value, error) {
  const power = error > 0 && isFinite(error) ? Math.floor(Math.log10(error)) : NaN, places = (error < 3.55 * 10 ** power ? 1 : 0) - power;
  if (isNaN(power) || places > 12 || !isFinite(value)) return digits(value, 4);
  return (places > 0 ? value.toFixed(places) : String(Math.round(value * 10 ** places) / 10 ** places)).replace("-", "−");
}
const withUnit = (text, unit) => (unit === "1" ? text : `${text}\u00a0${unit}`);
const said = (value, unit, count) => { const [one, name] = fitting(value, unit); return withUnit(digits(value / one, count), name); };

// --- the expansion of a study: outputs and displacements for parameters of which some are fixed, others random --------
class Expansion {
  constructor(told, arrays) {
    this.parameters = told.parameters; this.indices = told.indices; this.wanted = told.outputs; this.field = told.field || null;
    this.modes = told.field ? arrays[told.field.modes] : null;
    this.fixed = this.parameters.map(() => false);
    this.values = this.parameters.map((p) => p.start);
    this.regroup();
  }
  coordinate(i, value) {
    const p = this.parameters[i];
    return ((p.logarithmic ? Math.log(value) : value) - p.centre) / p.scale;
  }
  table(i, t) {  // orthonormal polynomials by their three-term recurrence
    const { alpha, beta } = this.parameters[i], found = [1];
    for (let k = 0; k + 1 < alpha.length; k++) {
      const root = Math.sqrt(beta[k + 1]);
      found.push((t - alpha[k]) * found[k] / root - (k ? Math.sqrt(beta[k]) / root * found[k - 1] : 0));
    }
    return found;
  }
  // Terms with the same degrees in the random parameters belong together: what is left of the expansion once the others
  // are fixed is again one in orthonormal functions, of which the first is its mean.
  regroup() {
    const groups = new Map();
    this.groupOf = this.indices.map((index) => {
      const key = index.map((a, i) => (this.fixed[i] ? 0 : a));
      const name = key.join(",");
      if (!groups.has(name)) groups.set(name, { key, number: groups.size });
      return groups.get(name).number;
    });
    this.groups = [...groups.values()];
    const zero = this.indices[0].map(() => 0).join(",");
    this.first = groups.has(zero) ? groups.get(zero).number : -1;
    this.samples = null;
  }
  psi() {  // of each term, its factors in the fixed parameters
    const tables = this.parameters.map((_, i) => (this.fixed[i] ? this.table(i, this.coordinate(i, this.values[i])) : null));
    return this.indices.map((index) => index.reduce((product, a, i) => (a && tables[i] ? product * tables[i][a] : product), 1));
  }
  drawn() {  // values of the remaining functions at points of the random parameters, evenly spread
    if (this.samples) return this.samples;
    const free = this.parameters.map((_, i) => i).filter((i) => !this.fixed[i]);
    if (!free.length) return (this.samples = []);
    let root = 2;
    for (let k = 0; k < 30; k++) root = (1 + root) ** (1 / (free.length + 1));  // M. Roberts' sequence
    const N = 1024;
    this.samples = Array.from({ length: N }, (_, k) => {
      const tables = {};
      free.forEach((i, j) => {
        const q = this.parameters[i].quantiles;
        const u = (0.5 + (k + 1) * root ** -(j + 1)) % 1, place = Math.min(Math.max(u * q.length - 0.5, 0), q.length - 1);
        const low = Math.floor(place), high = Math.min(low + 1, q.length - 1);
        tables[i] = this.table(i, q[low] + (place - low) * (q[high] - q[low]));
      });
      return Float64Array.from(this.groups, ({ key }) => key.reduce((product, a, i) => (a ? product * tables[i][a] : product), 1));
    });
    return this.samples;
  }
  outputs() {
    const psi = this.psi(), samples = this.drawn();
    return this.wanted.map((output) => {
      const left = new Float64Array(this.groups.length);
      output.coefficients.forEach((c, k) => { left[this.groupOf[k]] += c * psi[k]; });
      const mean = this.first >= 0 ? left[this.first] : 0;
      let variance = 0;
      const totals = this.parameters.map(() => 0);
      this.groups.forEach(({ key, number }) => {
        if (number === this.first) return;
        variance += left[number] ** 2;
        key.forEach((a, i) => { if (a) totals[i] += left[number] ** 2; });
      });
      const values = samples.map((row) => row.reduce((sum, x, g) => sum + x * left[g], 0));
      return this.said(output, mean, variance, values, totals.map((total) => (variance > 0 ? total / variance : 0)));
    });
  }
  said({ name, unit, error }, mean, variance, values, shares) {  // of an output that has these values, if it has any
    values.sort((a, b) => a - b);
    const at = (p) => values[Math.min(values.length - 1, Math.floor(p * values.length))];
    const interval = values.length ? [at(0.025), at(0.975)] : [mean - 1.96 * error, mean + 1.96 * error];
    return { name, unit, mean, std: Math.sqrt(variance), error, values, interval, shares };
  }
  amplitudes() {  // of the modes, for each group of terms
    const factors = this.field.factors, r = factors[0].length, psi = this.psi();
    const left = this.groups.map(() => new Float64Array(r));
    this.groupOf.forEach((g, k) => { for (let j = 0; j < r; j++) left[g][j] += psi[k] * factors[k][j]; });
    return left;
  }
  displacements(out) {
    return this.combined(this.amplitudes()[this.first] || new Float64Array(this.field.factors[0].length), out);
  }
  combined(a, out) {
    const r = a.length, modes = this.modes, n = modes.length / r;
    for (let v = 0, p = 0; v < n; v += 3, p += 3 * r) {  // a row of modes: x of all, y of all, z of all
      let x = 0, y = 0, z = 0;
      for (let j = 0; j < r; j++) {
        const aj = a[j];
        x += aj * modes[p + j]; y += aj * modes[p + r + j]; z += aj * modes[p + 2 * r + j];
      }
      out[v] = x; out[v + 1] = y; out[v + 2] = z;
    }
    return out;
  }
  deviations(nodes) {  // length of the standard deviations of the three components, at each node
    const sum = new Float32Array(nodes), one = new Float32Array(3 * nodes);
    this.amplitudes().forEach((a, g) => {
      if (g === this.first) return;
      this.combined(a, one);
      for (let v = 0; v < nodes; v++) sum[v] += one[3 * v] ** 2 + one[3 * v + 1] ** 2 + one[3 * v + 2] ** 2;
    });
    return sum.map(Math.sqrt);
  }
  outside() {
    return this.parameters.filter((p, i) => this.fixed[i] &&
      (this.values[i] < p.fitted[0] - 1e-9 * (p.high - p.low) || this.values[i] > p.fitted[1] + 1e-9 * (p.high - p.low)));
  }
}

// --- parameters that depend on each other: what is not fixed follows what is ---------------------------------------------
function solved(rows, k) {  // X of A X = B, given the rows of (A B) with A (k, k), by Gaussian elimination
  for (let p = 0; p < k; p++) {
    let best = p;
    for (let q = p; q < k; q++) if (Math.abs(rows[q][p]) > Math.abs(rows[best][p])) best = q;
    [rows[p], rows[best]] = [rows[best], rows[p]];
    for (let q = 0; q < k; q++) {
      const f = q === p ? 0 : rows[q][p] / rows[p][p];
      if (f) for (let c = p; c < rows[q].length; c++) rows[q][c] -= f * rows[p][c];
    }
  }
  return rows.map((row, p) => row.slice(k).map((y) => y / row[p]));
}

class Dependent extends Expansion {
  regroup() {
    this.first = this.indices.findIndex((index) => index.every((a) => !a));
    this.made = null;
  }
  of(arrays, joint) { this.joint = joint; this.samples = arrays[joint.samples]; return this; }
  gain(fixed) {  // C_SS⁻¹ C_S
    const C = this.joint.correlations;
    return solved(fixed.map((i) => [...fixed.map((j) => C[i][j]), ...C[i]]), fixed.length);
  }
  drawn() {  // standardised parameters: of samples that were moved to where some are fixed
    const key = JSON.stringify([this.fixed, this.values]);
    if (this.made && this.made.key === key) return this.made;
    const d = this.parameters.length, fixed = this.parameters.map((_, i) => i).filter((i) => this.fixed[i]);
    const at = this.parameters.map((_, i) => this.coordinate(i, this.values[i]));
    const n = fixed.length === d ? 1 : this.samples.length / d, gain = this.gain(fixed), x = new Float64Array(n * d);
    for (let k = 0; k < n; k++) {
      const row = x.subarray(k * d, (k + 1) * d);
      row.set(this.samples.subarray(k * d, (k + 1) * d));
      const off = fixed.map((i) => at[i] - row[i]);
      off.forEach((e, s) => gain[s].forEach((g, j) => { row[j] += e * g; }));
      fixed.forEach((i) => { row[i] = at[i]; });
    }
    const psi = Array.from({ length: n }, (_, k) => this.functions(x.subarray(k * d, (k + 1) * d)));
    return (this.made = { key, x, psi, n });
  }
  functions(row) {
    const { start, parting, indices, inverse, numbers } = this.joint;
    const tables = this.parameters.map((_, i) => {
      if (i < start) return this.table(i, row[i]);
      let t = 0;
      parting.forEach((column, j) => { t += row[start + j] * column[i - start]; });
      return this.table(i, t);
    });
    const products = indices.map((index) => index.reduce((product, a, i) => (a ? product * tables[start + i][a] : product), 1));
    const together = inverse[0].map((_, q) => products.reduce((sum, y, p) => sum + y * inverse[p][q], 0));
    return Float64Array.from(this.indices, (index, k) => {
      let product = together[numbers[k]];
      for (let i = 0; i < start; i++) if (index[i]) product *= tables[i][index[i]];
      return product;
    });
  }
  outputs() {
    const { psi, n } = this.drawn(), some = this.fixed.some(Boolean);
    return this.wanted.map((output) => {
      const c = output.coefficients, values = psi.map((row) => row.reduce((sum, y, k) => sum + y * c[k], 0));
      let mean = values.reduce((a, b) => a + b, 0) / n, variance = values.reduce((a, b) => a + (b - mean) ** 2, 0) / n;
      if (!some) { mean = c[this.first]; variance = c.reduce((sum, y, k) => (k === this.first ? sum : sum + y * y), 0); }
      return this.said(output, mean, variance, n > 1 ? values : [], null);
    });
  }
  follows(i) {  // the middle of a parameter, given those that are fixed
    const { x, n } = this.drawn(), d = this.parameters.length, p = this.parameters[i];
    let mean = 0;
    for (let k = 0; k < n; k++) mean += x[k * d + i] / n;
    const value = p.centre + p.scale * mean;
    return p.logarithmic ? Math.exp(value) : value;
  }
  amplitudes() {
    const { psi } = this.drawn(), { factors } = this.field, r = factors[0].length;
    return psi.map((row) => { const a = new Float64Array(r); row.forEach((y, k) => { for (let j = 0; j < r; j++) a[j] += y * factors[k][j]; }); return a; });
  }
  displacements(out) {
    const all = this.amplitudes(), a = new Float64Array(all[0].length);
    all.forEach((one) => one.forEach((y, j) => { a[j] += y / all.length; }));
    return this.combined(a, out);
  }
  deviations(nodes) {
    const all = this.amplitudes(), r = all[0].length, mean = new Float64Array(r), C = Array.from({ length: r }, () => new Float64Array(r));
    all.forEach((one) => one.forEach((y, j) => { mean[j] += y / all.length; }));
    all.forEach((one) => { for (let i = 0; i < r; i++) for (let j = 0; j < r; j++) C[i][j] += (one[i] - mean[i]) * (one[j] - mean[j]) / all.length; });
    const sum = new Float32Array(nodes), modes = this.modes;
    for (let v = 0; v < nodes; v++) {
      let total = 0;
      for (let c = 0; c < 3; c++) {
        const p = (3 * v + c) * r;
        for (let i = 0; i < r; i++) for (let j = 0; j < r; j++) total += modes[p + i] * C[i][j] * modes[p + j];
      }
      sum[v] = Math.sqrt(Math.max(total, 0));
    }
    return sum;
  }
  outside() {  // beyond the range of a parameter, or where no draw has this combination
    const found = super.outside(), fixed = this.parameters.map((_, i) => i).filter((i) => this.fixed[i]);
    if (found.length || fixed.length < 2) return found;
    const d = this.parameters.length, k = fixed.length, C = this.joint.correlations;
    // How far from the middle: vᵀ C_SS⁻¹ v, for the fixed values and for all draws.
    const unit_ = fixed.map((_, s) => fixed.map((__, q) => Number(s === q)));
    const inverse = solved(fixed.map((i, s) => [...fixed.map((j) => C[i][j]), ...unit_[s]]), k);
    const far = (v) => v.reduce((sum, y, s) => sum + v.reduce((part, z, q) => part + y * inverse[s][q] * z, 0), 0);
    let most = 0;
    for (let n = 0; n < this.samples.length / d; n++) most = Math.max(most, far(fixed.map((i) => this.samples[n * d + i])));
    return far(fixed.map((i) => this.coordinate(i, this.values[i]))) > most ? fixed.map((i) => this.parameters[i]) : [];
  }
}

// --- colours ---------------------------------------------------------------------------------------------------------
const MAPS = {
  viridis: ["440154", "482878", "3e4989", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725"],
  plasma: ["0d0887", "46039f", "7201a8", "9c179e", "bd3786", "d8576b", "ed7953", "fb9f3a", "fdca26", "f0f921"],
  cividis: ["00224e", "123570", "3b496c", "575d6d", "707173", "8a8678", "a59c74", "c3b369", "e1cc55", "fee838"],
  coolwarm: ["3b4cc0", "6282ea", "8db0fe", "b8d0f9", "dddddd", "f5c4ad", "f49a7b", "de604d", "b40426"],
};
const CATEGORIES = ["1f77b4", "ff7f0e", "2ca02c", "d62728", "9467bd", "8c564b", "e377c2", "bcbd22", "17becf"];
const rgb = (hex) => [0, 2, 4].map((k) => parseInt(hex.replace("#", "").slice(k, k + 2), 16));
function colourTable(name) {
  const stops = (MAPS[name] || MAPS.viridis).map(rgb), table = new Uint8Array(256 * 4);
  for (let i = 0; i < 256; i++) {
    const x = (i / 255) * (stops.length - 1), k = Math.min(Math.floor(x), stops.length - 2);
    for (let c = 0; c < 3; c++) table[4 * i + c] = Math.round(stops[k][c] + (x - k) * (stops[k + 1][c] - stops[k][c]));
    table[4 * i + 3] = 255;
  }
  return table;
}

// --- vectors and matrices (column by column, as WebGL has them) --------------------------------------------------------
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const l = Math.hypot(...a) || 1; return a.map((x) => x / l); };
const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);

const SURFACE = [`attribute vec3 place; attribute vec3 normal; attribute float value; uniform mat4 seen; uniform vec3 eye;
  varying vec3 n; varying float v; varying vec3 to;
  void main() { gl_Position = seen * vec4(place, 1.0); n = normal; v = value; to = eye - place; }`,
`precision mediump float; varying vec3 n; varying float v; varying vec3 to; uniform sampler2D colours; uniform vec4 paint;
  uniform float alpha; uniform vec3 lamp;
  void main() { vec3 m = normalize(n); if (dot(m, to) < 0.0) m = -m;
    vec3 base = paint.a > 0.5 ? paint.rgb : (v < -0.5 ? vec3(0.79, 0.81, 0.83) : texture2D(colours, vec2(clamp(v, 0.002, 0.998), 0.5)).rgb);
    float light = 0.5 + 0.5 * max(dot(m, lamp), 0.0) + 0.12 * max(dot(m, normalize(to)), 0.0);
    float rim = alpha < 1.0 ? 0.5 * (1.0 - abs(dot(m, normalize(to)))) : 0.0;
    gl_FragColor = vec4(base * min(light, 1.08), min(1.0, alpha + rim * alpha)); }`];
const LINE = [`attribute vec3 place; uniform mat4 seen; uniform float size;
  void main() { gl_Position = seen * vec4(place, 1.0); gl_PointSize = size; }`,
`precision mediump float; uniform vec4 paint; void main() { gl_FragColor = paint; }`];

// Smooth normals (3 n) of triangles between places (3 n).
function normalsOf(places, triangles, out) {
  out.fill(0);
  for (let t = 0; t < triangles.length; t += 3) {
    const a = 3 * triangles[t], b = 3 * triangles[t + 1], c = 3 * triangles[t + 2];
    const ux = places[b] - places[a], uy = places[b + 1] - places[a + 1], uz = places[b + 2] - places[a + 2];
    const vx = places[c] - places[a], vy = places[c + 1] - places[a + 1], vz = places[c + 2] - places[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    out[a] += x; out[a + 1] += y; out[a + 2] += z;
    out[b] += x; out[b + 1] += y; out[b + 2] += z;
    out[c] += x; out[c + 1] += y; out[c + 2] += z;
  }
  return out;
}

// Triangles where a function of the nodes is zero in tetrahedra (4 t): ends (2) and share of each corner.
function cutOf(cells, values) {
  const a = [], b = [], s = [];
  const put = (i, j) => { a.push(i); b.push(j); s.push(values[i] / (values[i] - values[j])); };
  for (let t = 0; t < cells.length; t += 4) {
    const inside = [], outside = [];
    for (let k = 0; k < 4; k++) (values[cells[t + k]] < 0 ? inside : outside).push(cells[t + k]);
    if (inside.length === 1) for (const j of outside) put(inside[0], j);
    else if (inside.length === 3) for (const i of inside) put(i, outside[0]);
    else if (inside.length === 2) {
      put(inside[0], outside[0]); put(inside[0], outside[1]); put(inside[1], outside[1]);
      put(inside[0], outside[0]); put(inside[1], outside[1]); put(inside[1], outside[0]);
    }
  }
  return { a, b, s };
}

// --- parts of a page -----------------------------------------------------------------------------------------------
function make(tag, set = {}, ...inner) {
  const made = Object.assign(document.createElement(tag), set);
  made.append(...inner);
  return made;
}
function curve(paths) {  // as the answers of a report have it
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const set = { viewBox: "0 0 100 20", preserveAspectRatio: "none", class: "curve", "aria-hidden": "true" };
  for (const [name, value] of Object.entries(set)) svg.setAttribute(name, value);
  svg.innerHTML = paths;
  return svg;
}

class Viewer {
  constructor(element, told, arrays) {
    this.element = element; this.told = told; this.arrays = arrays;
    this.canvas = element.querySelector("canvas");
    const gl = (this.gl = this.canvas.getContext("webgl2", { antialias: true, alpha: true, preserveDrawingBuffer: false }));
    if (!gl) throw new Error("no WebGL");
    const get = (number) => (number === null || number === undefined ? null : arrays[number]);
    this.points = get(told.points); this.nodes = this.points.length / 3;
    this.motion = get(told.motion) ? Float32Array.from(get(told.motion)) : new Float32Array(3 * this.nodes);
    this.base = Float32Array.from(this.motion);
    this.moves = told.motion !== null;
    this.edges = get(told.edges); this.cells = get(told.cells);
    const skin = () => this.surface(get(told.skin.triangles), get(told.skin.nodes));
    this.skin = skin();
    if (this.moves) this.ghost = skin();  // the body as it was
    this.insides = told.insides.map((inside) => Object.assign(this.surface(get(inside.triangles), get(inside.nodes), get(inside.points)), {
      name: inside.name, paint: rgb(inside.colour).map((x) => x / 255), opacity: inside.opacity, shown: inside.shown, outside: inside.outside,
    }));
    this.arrows = told.arrows.map((a) => ({ name: a.name, places: get(a.places), vectors: get(a.vectors), sizes: get(a.sizes), shown: false }));
    this.expansion = told.sliders ? (told.sliders.joint ? new Dependent(told.sliders, arrays).of(arrays, told.sliders.joint) : new Expansion(told.sliders, arrays)) : null;
    this.warp = 1; this.outlined = true; this.opacity = this.insides.some((i) => i.shown && !i.outside) ? 0.22 : 1;
    this.cut = { axis: told.cut, place: 0.5 };
    this.surfaceProgram = this.program(...SURFACE); this.lineProgram = this.program(...LINE);
    this.texture = gl.createTexture(); this.lineBuffer = gl.createBuffer();
    this.home(); this.choose(0); this.controls(); this.gestures();
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }
  surface(triangles, nodes, points) {
    const gl = this.gl, count = nodes ? nodes.length : points.length / 3;
    const one = { triangles, nodes, points, count, places: new Float32Array(3 * count), normals: new Float32Array(3 * count), values: new Float32Array(count) };
    one.buffers = [0, 1, 2].map(() => gl.createBuffer());
    one.index = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, one.index);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint32Array.from(triangles), gl.STATIC_DRAW);
    return one;
  }
  program(vertex, fragment) {
    const gl = this.gl, made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return made;
  }

  // --- what is seen ---
  home() {
    // The body as it was, and as it moved: as many of its nodes as tell where it ends.
    const places = [], step = Math.max(1, Math.floor(this.skin.count / 1500)), outer = new Set();
    const low = [Infinity, Infinity, Infinity], high = low.map((x) => -x);
    const seen = (k) => {
      const p = [0, 1, 2].map((c) => this.points[3 * k + c]), q = p.map((x, c) => x + this.base[3 * k + c]);
      for (const r of [p, q]) { places.push(r); r.forEach((x, i) => { low[i] = Math.min(low[i], x); high[i] = Math.max(high[i], x); }); }
    };
    for (let i = 0; i < this.skin.count; i += step) outer.add(this.skin.nodes[i]);
    for (let c = 0; c < 3; c++) {
      const by = [...this.skin.nodes].reduce(([a, b], k) => [this.points[3 * k + c] < this.points[3 * a + c] ? k : a, this.points[3 * k + c] > this.points[3 * b + c] ? k : b], [this.skin.nodes[0], this.skin.nodes[0]]);
      by.forEach((k) => outer.add(k));
    }
    outer.forEach(seen);
    this.outermost = places; this.size = Math.hypot(...high.map((x, i) => x - low[i])) || 1;
    this.centre = low.map((x, i) => (x + high[i]) / 2);
    const up = this.told.up, right = up[0] ? [0, 1, 0] : [1, 0, 0];
    this.up = up; this.east = right; this.north = cross(right, up);
    this.azimuth = Math.atan2(0.6, 1); this.height = 0.33; this.zoom = 1; this.shift = [0, 0];
    this.draw();
  }
  view() {
    const c = Math.cos(this.height), towards = unit(add(add(this.north.map((x) => x * c * Math.cos(this.azimuth)),
      this.east, c * Math.sin(this.azimuth)), this.up, Math.sin(this.height)));
    const side = unit(cross(this.up, towards)), top = cross(towards, side);
    // The body fills the picture, as it is seen from here; the eye is far away, for a little perspective.
    const { clientWidth: w, clientHeight: h } = this.canvas, aspect = (w || 1) / (h || 1), far = 5 * this.size;
    let wide = 1e-12, tall = 1e-12;
    for (const place of this.outermost) {
      const d = add(place, this.centre, -1), grown = far / (far - dot(d, towards));
      wide = Math.max(wide, grown * Math.abs(dot(d, side))); tall = Math.max(tall, grown * Math.abs(dot(d, top)));
    }
    const half = 1.06 * Math.max(tall, wide / aspect) / this.zoom;
    const middle = add(add(this.centre, side, -this.shift[0] * half), top, -this.shift[1] * half);
    const eye = add(middle, towards, far), near = 0.1 * far, end = 2 * far;
    const f = far / half, a = -(end + near) / (end - near), b = (-2 * end * near) / (end - near), m = new Float32Array(16);
    for (let j = 0; j < 3; j++) { m[4 * j] = (f / aspect) * side[j]; m[4 * j + 1] = f * top[j]; m[4 * j + 2] = a * towards[j]; m[4 * j + 3] = -towards[j]; }
    m[12] = -(f / aspect) * dot(side, eye); m[13] = -f * dot(top, eye); m[14] = b - a * dot(towards, eye); m[15] = dot(towards, eye);
    this.toEye = towards;
    return { seen: m, eye, lamp: unit(add(add(towards.map((x) => 0.8 * x), top, 0.5), side, 0.3)) };
  }
  choose(number) {
    this.chosen = number;
    const q = this.told.quantities[number], gl = this.gl;
    this.map = colourTable(q.colours);
    if (q.names.length) q.names.forEach((_, i) => {
      const c = rgb(CATEGORIES[i % CATEGORIES.length]);
      for (let k = Math.floor(256 * i / q.names.length); k < 256 * (i + 1) / q.names.length; k++) this.map.set(c, 4 * k);
    });
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, this.map);
    for (const [name, value] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR], [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]])
      gl.texParameteri(gl.TEXTURE_2D, name, value);
    this.update();
  }
  numbers() {  // of the chosen quantity at the nodes; once parameters are fixed, that of the expansion
    const q = this.told.quantities[this.chosen], x = this.expansion;
    if (x && x.field && x.fixed.some(Boolean)) {
      if (this.chosen === 0) {
        const out = (this.sizes ||= new Float32Array(this.nodes)), u = this.motion;
        for (let i = 0; i < this.nodes; i++) out[i] = Math.sqrt(u[3 * i] * u[3 * i] + u[3 * i + 1] * u[3 * i + 1] + u[3 * i + 2] * u[3 * i + 2]);
        return out;
      }
      if (q.std) return x.deviations(this.nodes);
    }
    return this.arrays[q.values];
  }
  update() {
    const q = this.told.quantities[this.chosen], x = this.expansion;
    if (x && x.field) { if (x.fixed.some(Boolean)) x.displacements(this.motion); else this.motion.set(this.base); }
    const warp = q.still ? 0 : this.warp, values = this.numbers();
    const count = q.names.length, low = count ? -0.5 : q.low, width = count ? count : q.high - q.low;
    for (const s of [this.skin, ...this.insides]) this.place(s, warp, values, low, width);
    if (this.ghost && !this.ghost.placed) { this.place(this.ghost, 0, values, low, width); this.ghost.placed = true; }
    this.slice(warp, values, low, width);
    if (this.told_ !== this.chosen) { this.told_ = this.chosen; this.legend(); }
    this.draw();
  }
  place(s, warp, values, low, width) {
    const gl = this.gl, { places, nodes, count } = s, category = this.told.quantities[this.chosen].names.length > 0;
    if (nodes) {
      const p = this.points, u = this.motion;
      for (let i = 0; i < count; i++) {
        const k = 3 * nodes[i], j = 3 * i, v = values[nodes[i]];
        places[j] = p[k] + warp * u[k]; places[j + 1] = p[k + 1] + warp * u[k + 1]; places[j + 2] = p[k + 2] + warp * u[k + 2];
        s.values[i] = v !== v || (category && v < low) ? -1 : Math.max((v - low) / width, 0);
      }
    } else places.set(s.points);
    normalsOf(places, s.triangles, s.normals);
    [places, s.normals, s.values].forEach((data, i) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, s.buffers[i]);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    });
  }
  slice(warp, values, low, width) {
    if (this.sliced) [...this.sliced.buffers, this.sliced.index].forEach((buffer) => this.gl.deleteBuffer(buffer));
    this.sliced = null;
    if (!this.cell()) return;
    const axis = "xyz".indexOf(this.cut.axis), level = new Float32Array(this.nodes);
    if (axis >= 0) {
      const at = this.box0[0][axis] + this.cut.place * (this.box0[1][axis] - this.box0[0][axis]);
      for (let i = 0; i < this.nodes; i++) level[i] = this.points[3 * i + axis] - at;
    } else {
      const q = this.told.quantities[this.chosen], at = q.low + this.cut.place * (q.high - q.low);
      for (let i = 0; i < this.nodes; i++) level[i] = values[i] - at;
    }
    for (let i = 0; i < this.nodes; i++) if (!level[i]) level[i] = 1e-20;
    const { a, b, s } = cutOf(this.cells, level), count = a.length;
    const points = new Float32Array(3 * count), shown = new Float32Array(count);
    for (let i = 0; i < count; i++) {
      for (let c = 0; c < 3; c++) {
        const x = this.points[3 * a[i] + c] + warp * this.motion[3 * a[i] + c], y = this.points[3 * b[i] + c] + warp * this.motion[3 * b[i] + c];
        points[3 * i + c] = x + s[i] * (y - x);
      }
      shown[i] = Math.max((values[a[i]] + s[i] * (values[b[i]] - values[a[i]]) - low) / width, 0);
    }
    if (!count) return;
    this.sliced = this.surface(Array.from({ length: count }, (_, i) => i), null, points);
    this.sliced.values = shown;
    this.place(this.sliced, 0, values, low, width);
  }
  cell() {
    if (!this.cut.axis || !this.cells) return false;
    if (!this.box0) {
      this.box0 = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
      this.points.forEach((v, i) => { this.box0[0][i % 3] = Math.min(this.box0[0][i % 3], v); this.box0[1][i % 3] = Math.max(this.box0[1][i % 3], v); });
    }
    return true;
  }

  // --- drawing ---
  draw() { if (!this.waiting) { this.waiting = true; requestAnimationFrame(() => { this.waiting = false; this.paint(); }); } }
  paint() {
    const gl = this.gl, canvas = this.canvas, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
    if (!w || !h) return;
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h);
    gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST); gl.depthFunc(gl.LEQUAL);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const view = this.view(), dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const see = this.cut.axis ? Math.min(this.opacity, 0.18) : this.opacity;
    if (this.sliced) this.paintSurface(this.sliced, view, 1);
    for (const s of this.insides) if (s.shown && s.opacity >= 1) this.paintSurface(s, view, 1, s.paint);
    if (see >= 1) this.paintSurface(this.skin, view, 1);
    const line = dark ? [0.75, 0.8, 0.86, 0.8] : [0.45, 0.5, 0.56, 0.8];
    if (this.outlined && this.edges) {
      const at = (warp) => { const out = new Float32Array(3 * this.edges.length); this.edges.forEach((k, i) => { for (let c = 0; c < 3; c++) out[3 * i + c] = this.points[3 * k + c] + warp * this.motion[3 * k + c]; }); return out; };
      if (this.moves) this.paintLines(at(0), view, line);
      const still = this.told.quantities[this.chosen].still;
      this.paintLines(at(still ? 0 : this.warp), view, dark ? [1, 1, 1, 0.7] : [0.11, 0.15, 0.2, 0.7]);
    }
    for (const a of this.arrows) if (a.shown) this.paintArrows(a, view);
    gl.enable(gl.BLEND); gl.depthMask(false); gl.enable(gl.CULL_FACE);
    for (const side of [gl.FRONT, gl.BACK]) {
      gl.cullFace(side);
      for (const s of this.insides) if (s.shown && s.opacity < 1) this.paintSurface(s, view, s.opacity, s.paint);
      if (see < 1 && see > 0) this.paintSurface(this.skin, view, see);
    }
    gl.disable(gl.CULL_FACE);
    if (this.outlined && this.ghost && this.warp) this.paintSurface(this.ghost, view, 0.05, line.slice(0, 3));
    gl.depthMask(true); gl.disable(gl.BLEND);
    this.element.dataset.frames = Number(this.element.dataset.frames || 0) + 1;
  }
  paintSurface(s, view, alpha, paint) {
    const gl = this.gl, program = this.surfaceProgram;
    gl.useProgram(program);
    ["place", "normal", "value"].forEach((name, i) => {
      const where = gl.getAttribLocation(program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, s.buffers[i]); gl.enableVertexAttribArray(where);
      gl.vertexAttribPointer(where, i < 2 ? 3 : 1, gl.FLOAT, false, 0, 0);
    });
    const at = (name) => gl.getUniformLocation(program, name);
    gl.uniformMatrix4fv(at("seen"), false, view.seen); gl.uniform3fv(at("eye"), view.eye); gl.uniform3fv(at("lamp"), view.lamp);
    gl.uniform4fv(at("paint"), paint ? [...paint, 1] : [0, 0, 0, 0]); gl.uniform1f(at("alpha"), alpha);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, s.index);
    gl.enable(gl.POLYGON_OFFSET_FILL); gl.polygonOffset(1, 1);
    gl.drawElements(gl.TRIANGLES, s.triangles.length, gl.UNSIGNED_INT, 0);
    gl.disable(gl.POLYGON_OFFSET_FILL);
  }
  paintLines(places, view, colour, mode = this.gl.LINES, size = 1) {
    const gl = this.gl, program = this.lineProgram;
    gl.useProgram(program);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer); gl.bufferData(gl.ARRAY_BUFFER, places, gl.DYNAMIC_DRAW);
    const where = gl.getAttribLocation(program, "place");
    gl.enableVertexAttribArray(where); gl.vertexAttribPointer(where, 3, gl.FLOAT, false, 0, 0);
    gl.uniformMatrix4fv(gl.getUniformLocation(program, "seen"), false, view.seen);
    gl.uniform4fv(gl.getUniformLocation(program, "paint"), colour); gl.uniform1f(gl.getUniformLocation(program, "size"), size);
    gl.enable(gl.BLEND); gl.drawArrays(mode, 0, places.length / 3); gl.disable(gl.BLEND);
  }
  paintArrows(a, view) {
    // The largest arrow is a tenth of the body; heads of two lines each lie across the line of sight.
    let longest = 1e-300;
    for (let i = 0; i < a.vectors.length; i += 3) longest = Math.max(longest, Math.hypot(a.vectors[i], a.vectors[i + 1], a.vectors[i + 2]));
    const scale = (a.scale = 0.12 * this.told.extent / longest), large = [], small = [];
    for (let i = 0; i < a.sizes.length; i++) {
      const from = [...a.places.slice(3 * i, 3 * i + 3)], d = [...a.vectors.slice(3 * i, 3 * i + 3)].map((x) => scale * x), to = add(from, d);
      const wing = unit(cross(d, this.toEye)).map((x) => 0.12 * Math.hypot(...d) * x), back = add(to, d, -0.28);
      (a.sizes[i] > 2 ? large : small).push(...from, ...to, ...to, ...add(back, wing), ...to, ...add(back, wing, -1));
    }
    this.paintLines(Float32Array.from(a.places), view, [0.1, 0.4, 0.75, 1], this.gl.POINTS, 5 * Math.min(window.devicePixelRatio || 1, 2));
    this.paintLines(Float32Array.from(small), view, [0.1, 0.4, 0.75, 1]);
    this.paintLines(Float32Array.from(large), view, [0.76, 0.2, 0.1, 1]);
  }

  // --- what is written and touched ---
  legend() {
    const q = this.told.quantities[this.chosen], box = this.element.querySelector(".legend");
    const [one, name] = fitting(Math.max(Math.abs(q.low), Math.abs(q.high)), q.unit);
    if (q.names.length) {
      const colour = (i) => make("i", { style: `background: #${CATEGORIES[i % CATEGORIES.length]}` });
      box.replaceChildren(...q.names.map((label, i) => make("span", { className: "name" }, colour(i), label)));
      return;
    }
    const places = [0, 0.25, 0.5, 0.75, 1], number = (x) => digits((q.low + x * (q.high - q.low)) / one, 3);
    const stops = places.map((x) => `rgb(${this.map.slice(4 * Math.round(255 * x)).slice(0, 3).join(",")})`);
    const ticks = places.map((x) => make("span", {}, x === 1 ? withUnit(number(x), name) : number(x)));
    box.replaceChildren(make("div", { className: "bar", style: `background: linear-gradient(to right, ${stops.join(",")})` }),
      make("div", { className: "ticks" }, ...ticks));
  }
  controls() {
    const bar = this.element.querySelector(".controls");
    const label = (words, control) => make("label", {}, `${words} `, control);
    const check = (words, on, act) => { const box = make("input", { type: "checkbox", checked: on }); box.addEventListener("change", () => { act(box.checked); this.draw(); }); return make("label", {}, box, ` ${words}`); };
    const range = (low, high, value, act) => { const r = make("input", { type: "range", min: low, max: high, step: "any", value }); r.addEventListener("input", () => act(Number(r.value))); return r; };
    const select = make("select", { className: "quantity" }, ...this.told.quantities.map((q, i) => make("option", { value: i, textContent: q.name })));
    select.setAttribute("aria-label", "quantity by which the body is coloured");
    select.addEventListener("change", () => this.choose(Number(select.value)));
    bar.append(select);
    if (this.moves) {
      const out = make("output", { textContent: "×1" });
      const warp = range(0, 3, 1, (x) => { this.warp = x; out.textContent = `×${x.toFixed(1)}`; this.update(); });
      warp.className = "warp";
      bar.append(make("label", {}, "displacement ", warp, out), check("undeformed outline", true, (on) => { this.outlined = on; }));
    }
    if (this.insides.length) {
      const skin = range(0, 1, this.opacity, (x) => { this.opacity = x; this.draw(); });
      skin.className = "skin"; bar.append(label("skin", skin));
      this.insides.forEach((s) => { const c = check(s.name, s.shown, (on) => { s.shown = on; }); c.style.borderBottom = `2px solid rgb(${s.paint.map((x) => 255 * x)})`; bar.append(c); });
    }
    this.arrows.forEach((a) => bar.append(check(`residuals, ${a.name}`, a.shown, (on) => {
      a.shown = on;
      requestAnimationFrame(() => requestAnimationFrame(() => {
        const shown = this.arrows.filter((x) => x.shown);
        note.textContent = shown.length ? `arrows: measured minus predicted, ${shown.map((x) => `×${digits(x.scale, 2)}`).join(", ")}; red beyond two standard deviations` : "";
      }));
    })));
    if (this.cells) {
      const where = range(0, 1, 0.5, (x) => { this.cut.place = x; this.update(); });
      where.setAttribute("aria-label", "place of the cut"); where.hidden = !this.cut.axis;
      const kind = make("select", { className: "cut" }, ...[["", "none"], ["x", "x"], ["y", "y"], ["z", "z"], ["v", "equal value"]].map(([value, words]) => make("option", { value, textContent: words })));
      kind.value = this.cut.axis;
      kind.addEventListener("change", () => { this.cut.axis = kind.value; where.hidden = !kind.value; this.update(); });
      bar.append(make("label", {}, "cut ", kind), where);
    }
    const note = make("span", { className: "note" });
    bar.append(note);
    const push = (words, title, act) => { const b = make("button", { type: "button", textContent: words, title }); b.setAttribute("aria-label", title); b.addEventListener("click", act); return b; };
    this.element.querySelector(".buttons").append(push("+", "nearer", () => this.nearer(1.25)), push("−", "farther", () => this.nearer(0.8)), push("⌂", "the first view", () => this.home()),
      push("PNG", "PNG: save the picture", () => { this.paint(); const link = document.createElement("a"); link.href = this.canvas.toDataURL("image/png"); link.download = "body.png"; link.click(); }));
    if (this.expansion) this.sliders();
  }
  nearer(by) { this.zoom = Math.min(Math.max(this.zoom * by, 0.3), 40); this.draw(); }
  turn(dx, dy) { this.azimuth -= dx; this.height = Math.min(Math.max(this.height + dy, -1.55), 1.55); this.draw(); }
  gestures() {
    const canvas = this.canvas, down = new Map();
    let apart = 0;
    canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); down.set(e.pointerId, [e.clientX, e.clientY]); apart = 0; });
    canvas.addEventListener("pointermove", (e) => {
      if (!down.has(e.pointerId)) return;
      const [x, y] = down.get(e.pointerId);
      down.set(e.pointerId, [e.clientX, e.clientY]);
      if (down.size > 1) {
        const [a, b] = [...down.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (apart) this.nearer(now / apart);
        apart = now;
      } else if (e.shiftKey || e.buttons === 2) {
        this.shift = add(this.shift, [2 * (e.clientX - x) / canvas.clientHeight, -2 * (e.clientY - y) / canvas.clientHeight]); this.draw();
      } else this.turn(0.008 * (e.clientX - x), 0.008 * (e.clientY - y));
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => { down.delete(e.pointerId); apart = 0; });
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    // The wheel scrolls the page until the body was touched.
    canvas.addEventListener("wheel", (e) => { if (document.activeElement === canvas || e.ctrlKey) { e.preventDefault(); this.nearer(Math.exp(-0.0015 * e.deltaY)); } }, { passive: false });
    canvas.addEventListener("keydown", (e) => {
      const act = { ArrowLeft: () => this.turn(-0.1, 0), ArrowRight: () => this.turn(0.1, 0), ArrowUp: () => this.turn(0, 0.1), ArrowDown: () => this.turn(0, -0.1),
        "+": () => this.nearer(1.15), "=": () => this.nearer(1.15), "-": () => this.nearer(0.87), Home: () => this.home(), 0: () => this.home() }[e.key];
      if (act) { e.preventDefault(); act(); }
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }
  sliders() {
    const panel = this.element.querySelector(".sliders"), x = this.expansion, rows = [];
    const table = make("div", { className: "told" }), warning = make("p", { className: "warning", hidden: true });
    warning.setAttribute("role", "status");
    const shown = () => {
      const outputs = x.outputs(), outside = x.outside(), fixed = x.fixed.some(Boolean);
      table.replaceChildren(...outputs.map((o, k) => {
        // Four digits, or fewer where the expansion knows fewer.
        const [one, name] = fitting(o.mean, o.unit), rest = x.fixed.every(Boolean), rough = o.error > 5e-4 * Math.abs(o.mean);
        const of = (v) => (rough ? rounded(v / one, o.error / one) : digits(v / one, 4));
        const words = rest ? `± ${rounded(o.error / one, o.error / one)} (${whose})` : `95 %: ${of(o.interval[0])} to ${of(o.interval[1])}`;
        const value = rest ? rounded(o.mean / one, o.error / one) : of(o.mean);
        return make("div", { className: "output" }, make("b", { textContent: o.name }), make("strong", { textContent: withUnit(value, name) }), make("span", { textContent: words }), bars(o, this.all[k]));
      }));
      rows.forEach((row, i) => {
        row.line.classList.toggle("fixed", x.fixed[i]);
        row.box.checked = x.fixed[i];
        const follows = x.joint && fixed && !x.fixed[i] ? x.follows(i) : null;
        if (follows !== null) row.range.value = follows;
        row.number.textContent = x.fixed[i] ? digits(x.values[i], 4) : follows !== null ? `about ${digits(follows, 3)}` : "random";
        const told = outputs.filter((o) => o.shares && o.shares[i] >= 0.005).slice(0, 3).map((o) => `${Math.round(100 * o.shares[i])} % of ${o.name}`);
        row.share.textContent = x.fixed[i] || !outputs[0].shares ? "" : told.length ? `of the variance: ${told.join(", ")}` : "below 1 % of all variances";
        const place = (x.values[i] - x.parameters[i].low) / (x.parameters[i].high - x.parameters[i].low);
        row.mark.setAttribute("x1", 100 * place); row.mark.setAttribute("x2", 100 * place);
        row.mark.style.display = x.fixed[i] ? "" : "none";
      });
      warning.hidden = !outside.length;
      warning.textContent = `Extrapolated: ${outside.map((p) => p.name).join(", ")} beyond the range of the samples.`;
      this.element.dataset.fixed = String(fixed);
    };
    const bars = (o, all) => {  // where the values lie, over where they lay before anything was fixed
      const low = all[0], high = all[all.length - 1], n = 40;
      const path = (values, kind) => {
        const counts = new Array(n).fill(0);
        for (const v of values) { const k = Math.floor(n * (v - low) / (high - low)); if (k >= 0 && k < n) counts[k]++; }
        const most = Math.max(...counts, 1);
        const steps = counts.map((c, k) => `L${100 * k / n} ${20 - 19 * c / most}L${100 * (k + 1) / n} ${20 - 19 * c / most}`);
        return `<path class="${kind}" d="M0 20${steps.join("")}L100 20Z"/>`;
      };
      if (!(high > low)) return curve("");
      const mark = `<path class="inside" d="M${100 * (o.mean - low) / (high - low) - 0.4} 0h.8v20h-.8Z"/>`;
      const now = x.fixed.some(Boolean) ? path(o.values, "inside") : "";
      return curve(path(all, "all") + (o.values.length ? now : mark));
    };
    this.all = x.outputs().map((o) => o.values);
    const moved = () => { shown(); if (x.field) this.update(); };
    x.parameters.forEach((p, i) => {
      const range = make("input", { type: "range", min: p.low, max: p.high, step: "any", value: p.start });
      range.setAttribute("aria-label", p.name); range.dataset.path = p.path;
      range.addEventListener("input", () => { if (!x.fixed[i]) { x.fixed[i] = true; x.regroup(); } x.values[i] = Number(range.value); moved(); });
      const box = make("input", { type: "checkbox" });
      box.addEventListener("change", () => { x.fixed[i] = box.checked; x.regroup(); moved(); });
      const d = p.density.map((y, k) => `L${100 * k / (p.density.length - 1)} ${20 - 19 * y}`).join("");
      const svg = curve(`<path class="all" d="M0 20${d}L100 20Z"/><line class="mark" y1="0" y2="20"/>`);
      const number = make("output", {}), share = make("small", {});
      const line = make("div", { className: "slider" }, make("label", { title: p.path }, box, ` ${p.name}`), number, range, svg, share);
      rows.push({ line, box, number, share, mark: svg.querySelector("line"), range });
    });
    const free = make("button", { type: "button", textContent: "all random again" });
    free.addEventListener("click", () => {
      x.fixed.fill(false); x.values = x.parameters.map((p) => p.start); rows.forEach((row, i) => { row.range.value = x.values[i]; }); x.regroup(); moved();
    });
    // What matters most comes first.
    const start = x.outputs(), weight = (i) => Math.max(...start.map((o) => (o.shares ? o.shares[i] : 0)));
    const many = 6, lines = rows.map((_, i) => i).sort((a, b) => weight(b) - weight(a) || a - b).map((i) => rows[i].line);
    const more = lines.length > many ? [make("details", {}, make("summary", { textContent: `${lines.length - many} more parameters` }), ...lines.slice(many))] : [];
    const loo = x.field ? x.field.loo : null;
    const error = x.field ? `The body is drawn to ${said(x.field.rounding, "m", 2)} of the expansion${loo !== null ? `, whose leave-one-out error is ${digits(100 * loo, 2)} % of the standard deviation` : ""}.` : "";
    const exact = [error, this.told.sliders.source].filter(Boolean).join(" ");
    const whose = this.told.sliders.source ? "of the expansion and the reduced model" : "of the expansion";
    const miss = Math.max(loo || 0, ...start.map((o) => (o.std > 0 && isFinite(o.error) ? o.error / o.std : 0)));
    const sketch = miss > 0.1 ? [make("p", { className: "warning", textContent: `A sketch: this expansion misses up to ${digits(100 * miss, 2)} % of the standard deviation of what it shows.` })] : [];
    panel.append(...sketch, make("p", { className: "note", textContent: `Move a slider to fix a parameter: the outputs${x.field ? " and the body" : ""} follow, and what stays random spreads them.${x.joint ? " These parameters depend on each other: those that are not fixed follow, to first order." : ""}` }),
      table, warning, make("div", { className: "rows" }, ...lines.slice(0, many), ...more), free,
      ...(exact ? [make("details", {}, make("summary", { textContent: "How exact this is" }), make("p", { className: "note", textContent: exact }))] : []));
    panel.hidden = false;
    shown();
  }
  // For tests and for the console.
  at(parameters) {
    const x = this.expansion;
    x.parameters.forEach((p, i) => { x.fixed[i] = p.path in parameters; if (x.fixed[i]) x.values[i] = parameters[p.path]; });
    x.regroup();
    if (x.field) this.update();
    return { outputs: x.outputs().map(({ name, mean, std, interval }) => ({ name, mean, std, interval })) };
  }
}

(async () => {
  for (const element of document.querySelectorAll(".viewer")) {
    try {
      const told = JSON.parse(element.querySelector("script[type='application/json']").textContent);
      const bytes = await inflate(element.querySelector("script[type='text/plain']").textContent.trim());
      element.viewer = new Viewer(element, told, unpack(told.arrays, bytes));
      element.dataset.state = "ready";
    } catch (error) {  // the static pictures stay
      element.dataset.state = "still"; element.dataset.why = String(error);
    }
  }
})();

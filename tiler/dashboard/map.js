// The map: tiles, or cells of tiles, and seams on a canvas; pointer, touch and keys.

export const STATES = ["waiting", "begun", "running", "done", "reused", "failed"];
export const FAILED = 5;
// Colours of the scale of values, from low to high: lightness rises evenly, so that grey keeps the order.
const RAMP = [[0, 32, 77], [44, 64, 110], [87, 93, 109], [118, 119, 121], [149, 144, 118], [188, 172, 97], [228, 203, 67], [255, 234, 70]];
const LEAST_MARK = 7; // px of a failed tile, however small its square is
const LEAST_SEAM = 14; // px of a tile's side, below which seams would hide the tiles
const FADED = 0.13;

export function rampColour(share) {
  const at = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1);
  const k = Math.min(Math.floor(at), RAMP.length - 2);
  const mixed = RAMP[k].map((low, axis) => Math.round(low + (at - k) * (RAMP[k + 1][axis] - low)));
  return `rgb(${mixed.join(",")})`;
}

// Share of a value between the least and the largest; by magnitude where these are far apart.
export function makeScale(range) {
  if (!range) return null;
  const [low, high] = range;
  const byMagnitude = low > 0 && high / low > 50;
  const place = byMagnitude ? Math.log : (value) => value;
  const span = place(high) - place(low);
  return { low, high, byMagnitude, share: (value) => (span > 0 ? (place(value) - place(low)) / span : 0.5) };
}

function pattern(base, mark, kind) {
  const tile = document.createElement("canvas");
  tile.width = tile.height = 6;
  const pen = tile.getContext("2d");
  pen.fillStyle = base;
  pen.fillRect(0, 0, 6, 6);
  pen.strokeStyle = pen.fillStyle = mark;
  if (kind === "dots") pen.fillRect(2, 2, 2, 2);
  else {
    pen.lineWidth = 1.2;
    pen.beginPath();
    for (const k of [-6, 0, 6]) { pen.moveTo(k, 6); pen.lineTo(k + 6, 0); }
    pen.stroke();
  }
  return tile;
}

export class Palette {
  constructor(pen) {
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    this.plain = STATES.map(colour);
    this.edge = colour("edge");
    this.mark = colour("mark");
    this.cross = colour("cross");
    this.focus = colour("focus");
    this.text = colour("text");
    this.ground = colour("ground");
    this.fill = [...this.plain];
    this.fill[2] = pen.createPattern(pattern(this.plain[2], this.mark, "hatch"), "repeat");
    this.fill[4] = pen.createPattern(pattern(this.plain[4], this.ground, "dots"), "repeat");
  }
}

export function drawCross(pen, palette, x, y, size) {
  pen.fillStyle = palette.plain[FAILED];
  pen.fillRect(x, y, size, size);
  pen.strokeStyle = palette.cross;
  pen.lineWidth = Math.max(1.5, size / 8);
  const inset = size * 0.24;
  pen.beginPath();
  pen.moveTo(x + inset, y + inset);
  pen.lineTo(x + size - inset, y + size - inset);
  pen.moveTo(x + size - inset, y + inset);
  pen.lineTo(x + inset, y + size - inset);
  pen.stroke();
}

const emptyLayer = () => ({ boxes: [], names: [], codes: [], values: [], tallies: [] });

function take(layer, rows) {
  for (const [k, code, value, tally] of rows) {
    layer.codes[k] = code;
    layer.values[k] = value;
    if (tally) layer.tallies[k] = tally;
  }
}

export class RegionMap {
  constructor(canvas, { onInspect, onView }) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.onInspect = onInspect;
    this.onView = onView;
    this.tiles = emptyLayer();
    this.seams = emptyLayer();
    this.hidden = new Set();
    this.level = 1;
    this.bounds = null;
    this.scale = this.seamScale = null;
    this.cursor = -1;
    this.zoom = 1;
    this.centre = null;
    this.frames = [];
    this.palette = new Palette(this.pen);
    this.pointers = new Map();
    new ResizeObserver(() => this.redraw()).observe(canvas);
    this.listen();
  }

  // Take an answer of the server.
  take(answer) {
    if (answer.whole) {
      const keep = this.tiles.names[this.cursor];
      this.tiles = { ...emptyLayer(), boxes: answer.boxes, names: answer.names };
      this.seams = { ...emptyLayer(), boxes: answer.seam_boxes || [], names: answer.seam_names || [] };
      this.cursor = keep ? this.tiles.names.indexOf(keep) : -1;
    }
    this.level = answer.level;
    this.bounds = answer.bounds;
    take(this.tiles, answer.rows);
    take(this.seams, answer.seams || []);
    this.redraw();
  }

  setScale(range, seamRange) {
    this.scale = makeScale(range);
    this.seamScale = makeScale(seamRange);
  }

  retheme() {
    this.palette = new Palette(this.pen);
    this.redraw();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => { this.waiting = 0; this.draw(); });
  }

  fitScale() {
    const [xmin, ymin, xmax, ymax] = this.bounds;
    const room = 14;
    return Math.min((this.canvas.clientWidth - room) / (xmax - xmin), (this.canvas.clientHeight - room) / (ymax - ymin));
  }

  frame() {
    const [xmin, ymin, xmax, ymax] = this.bounds;
    const k = this.fitScale() * this.zoom;
    const [x, y] = this.centre || [(xmin + xmax) / 2, (ymin + ymax) / 2];
    return { k, left: x - this.canvas.clientWidth / 2 / k, top: y + this.canvas.clientHeight / 2 / k };
  }

  // Part of the region that is on the canvas, a quarter more on every side; null where all is.
  view() {
    if (!this.bounds || this.zoom < 1.2) return null;
    const { k, left, top } = this.frame();
    const [width, height] = [this.canvas.clientWidth / k, this.canvas.clientHeight / k];
    return [left - width / 4, top - 1.25 * height, left + 1.25 * width, top + height / 4].map(Math.round);
  }

  draw() {
    const begin = performance.now();
    const { canvas, pen, palette } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    const drawn = [0, 0, 0, 0, 0, 0];
    if (this.bounds && canvas.clientWidth) {
      const place = this.frame();
      const failed = this.drawTiles(place, drawn);
      this.drawSeams(place);
      pen.globalAlpha = 1;
      for (const [x, y, w, h] of failed) {
        const size = Math.max(Math.min(w, h, 22), LEAST_MARK);
        drawCross(pen, palette, x + (w - size) / 2, y + (h - size) / 2, size);
      }
      this.drawCursor(place);
    }
    canvas.dataset.drawn = JSON.stringify(drawn);
    this.frames.push(performance.now() - begin);
    if (this.frames.length > 240) this.frames.shift();
    if (this.tiles.boxes.length && !document.body.dataset.firstDraw)
      document.body.dataset.firstDraw = performance.now().toFixed(1);
  }

  drawTiles({ k, left, top }, drawn) {
    const { pen, palette, tiles, scale } = this;
    const failed = [];
    const gap = this.level === 1 ? 1 : 0.5;
    pen.lineWidth = 1;
    pen.strokeStyle = palette.edge;
    for (let n = 0; n < tiles.boxes.length; n++) {
      const [xmin, ymin, xmax, ymax] = tiles.boxes[n];
      const x = (xmin - left) * k, y = (top - ymax) * k, w = (xmax - xmin) * k, h = (ymax - ymin) * k;
      if (x > this.canvas.clientWidth || y > this.canvas.clientHeight || x + w < 0 || y + h < 0) continue;
      const code = tiles.codes[n] || 0;
      const shown = !this.hidden.has(code);
      pen.globalAlpha = shown ? 1 : FADED;
      const room = Math.min(gap, w / 8, h / 8);
      const value = tiles.values[n];
      if (scale && value != null) pen.fillStyle = rampColour(scale.share(value));
      else pen.fillStyle = scale && code !== FAILED ? palette.plain[0] : w > 5 ? palette.fill[code] : palette.plain[code];
      pen.fillRect(x + room, y + room, w - 2 * room, h - 2 * room);
      if (w > 4 && (code <= 1 || (scale && value == null))) pen.strokeRect(x + room + 0.5, y + room + 0.5, w - 2 * room - 1, h - 2 * room - 1);
      if (shown) { drawn[code] += 1; if (code === FAILED) failed.push([x, y, w, h]); }
    }
    return failed;
  }

  drawSeams({ k, left, top }) {
    const { pen, palette, seams } = this;
    const some = seams.boxes[0];
    if (!some) return;
    const side = Math.max(some[2] - some[0], some[3] - some[1]) * k;
    this.seamsShown = side >= LEAST_SEAM;
    if (!this.seamsShown) return;
    const broad = Math.min(Math.max(side / 12, 2.5), 7);
    for (let n = 0; n < seams.boxes.length; n++) {
      const code = seams.codes[n] || 0;
      const value = seams.values[n];
      const [xmin, ymin, xmax, ymax] = seams.boxes[n];
      const flat = ymax - ymin < xmax - xmin;
      const inset = side * 0.16;
      const x = (xmin - left) * k, y = (top - ymax) * k, w = (xmax - xmin) * k, h = (ymax - ymin) * k;
      pen.globalAlpha = this.hidden.has(code) ? FADED : 1;
      const box = flat ? [x + inset, y + h / 2 - broad / 2, w - 2 * inset, broad] : [x + w / 2 - broad / 2, y + inset, broad, h - 2 * inset];
      pen.fillStyle = palette.ground;
      pen.fillRect(box[0] - 1, box[1] - 1, box[2] + 2, box[3] + 2);
      const scaled = this.seamScale && value != null;
      pen.fillStyle = scaled ? rampColour(this.seamScale.share(value)) : this.scale && code !== FAILED ? palette.plain[0] : palette.plain[code];
      pen.fillRect(...box);
      if (code === FAILED) drawCross(pen, palette, x + w / 2 - 6, y + h / 2 - 6, 12);
      else if (code <= 1) { pen.strokeStyle = palette.edge; pen.lineWidth = 1; pen.strokeRect(...box); }
    }
  }

  drawCursor({ k, left, top }) {
    if (this.cursor < 0 || !this.tiles.boxes[this.cursor]) return;
    const [xmin, ymin, xmax, ymax] = this.tiles.boxes[this.cursor];
    const { pen, palette } = this;
    const box = [(xmin - left) * k - 2, (top - ymax) * k - 2, (xmax - xmin) * k + 4, (ymax - ymin) * k + 4];
    pen.lineWidth = 5;
    pen.strokeStyle = palette.ground;
    pen.strokeRect(...box);
    pen.lineWidth = 3;
    pen.strokeStyle = palette.focus;
    pen.strokeRect(...box);
  }

  // What is below a place of the canvas: a seam if it is near, else a tile.
  find(px, py) {
    if (!this.bounds) return null;
    const { k, left, top } = this.frame();
    const x = left + px / k, y = top - py / k, near = 5 / k;
    const inside = ([xmin, ymin, xmax, ymax], room) => x >= xmin - room && x <= xmax + room && y >= ymin - room && y <= ymax + room;
    const seam = this.seams.boxes.findIndex((box) => {
      const inset = Math.max(box[2] - box[0], box[3] - box[1]) * 0.16;
      const flat = box[3] - box[1] < box[2] - box[0];
      return flat ? inside([box[0] + inset, box[1], box[2] - inset, box[3]], near) && x > box[0] + inset && x < box[2] - inset
        : inside([box[0], box[1] + inset, box[2], box[3] - inset], near) && y > box[1] + inset && y < box[3] - inset;
    });
    if (seam >= 0) return { layer: "seams", index: seam };
    const tile = this.tiles.boxes.findIndex((box) => inside(box, 0));
    return tile < 0 ? null : { layer: "tiles", index: tile };
  }

  select(index, { show = true } = {}) {
    this.cursor = index;
    if (show && index >= 0) this.reveal(this.tiles.boxes[index]);
    this.redraw();
    if (index >= 0) this.onInspect({ layer: "tiles", index });
  }

  reveal([xmin, ymin, xmax, ymax]) {
    const { k, left, top } = this.frame();
    const x = ((xmin + xmax) / 2 - left) * k, y = (top - (ymin + ymax) / 2) * k;
    if (x < 0 || y < 0 || x > this.canvas.clientWidth || y > this.canvas.clientHeight) {
      this.centre = [(xmin + xmax) / 2, (ymin + ymax) / 2];
      this.moved();
    }
  }

  // Go from the cursor to the nearest tile in a direction.
  step(dx, dy) {
    const { boxes } = this.tiles;
    if (!boxes.length) return;
    const middle = ([xmin, ymin, xmax, ymax]) => [(xmin + xmax) / 2, (ymin + ymax) / 2];
    if (this.cursor < 0) {
      const [xmin, , , ymax] = this.bounds;
      const distance = boxes.map((box) => { const [x, y] = middle(box); return x - xmin + ymax - y; });
      this.select(distance.indexOf(Math.min(...distance)));
      return;
    }
    const [x0, y0] = middle(boxes[this.cursor]);
    let best = -1, least = Infinity;
    boxes.forEach((box, n) => {
      const [x, y] = middle(box);
      const along = (x - x0) * dx + (y - y0) * dy;
      const across = Math.abs((x - x0) * dy) + Math.abs((y - y0) * dx);
      if (n === this.cursor || along <= 1e-6 || across > along) return;
      if (along + 2 * across < least) { least = along + 2 * across; best = n; }
    });
    if (best >= 0) this.select(best);
  }

  nextFailed() {
    const { codes } = this.tiles;
    for (let n = 1; n <= codes.length; n++) {
      const k = (this.cursor + n + codes.length) % codes.length;
      if (codes[k] === FAILED) { this.select(k); return true; }
    }
    return false;
  }

  zoomBy(factor, px = this.canvas.clientWidth / 2, py = this.canvas.clientHeight / 2) {
    if (!this.bounds) return;
    const before = this.frame();
    const [x, y] = [before.left + px / before.k, before.top - py / before.k];
    this.zoom = Math.min(Math.max(this.zoom * factor, 1), 400);
    const k = this.fitScale() * this.zoom;
    this.centre = this.zoom === 1 ? null
      : [x - (px - this.canvas.clientWidth / 2) / k, y + (py - this.canvas.clientHeight / 2) / k];
    this.moved();
  }

  fit() {
    this.zoom = 1;
    this.centre = null;
    this.moved();
  }

  moved() {
    this.redraw();
    clearTimeout(this.settling);
    this.settling = setTimeout(() => this.onView(this.view()), 250);
  }

  pan(dx, dy) {
    if (this.zoom === 1 || !this.bounds) return;
    const { k, left, top } = this.frame();
    this.centre = [left + this.canvas.clientWidth / 2 / k - dx / k, top - this.canvas.clientHeight / 2 / k + dy / k];
    this.moved();
  }

  listen() {
    const { canvas, pointers } = this;
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomBy(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event);
      this.dragged = 0;
    });
    canvas.addEventListener("pointermove", (event) => this.pointerMoved(event));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => {
      if (kind === "pointerup" && pointers.size === 1 && this.dragged < 6) {
        const found = this.find(event.offsetX, event.offsetY);
        if (found && found.layer === "tiles") this.select(found.index, { show: false });
        else if (found) this.onInspect(found);
      }
      pointers.delete(event.pointerId);
    });
    canvas.addEventListener("keydown", (event) => this.keyPressed(event));
  }

  pointerMoved(event) {
    const { pointers } = this;
    const before = pointers.get(event.pointerId);
    if (!before) {
      const found = this.find(event.offsetX, event.offsetY);
      if (found) this.onInspect(found);
      return;
    }
    const [dx, dy] = [event.offsetX - before.offsetX, event.offsetY - before.offsetY];
    this.dragged += Math.abs(dx) + Math.abs(dy);
    if (pointers.size === 1) this.pan(dx, dy);
    else if (pointers.size === 2) {
      const other = [...pointers.entries()].find(([id]) => id !== event.pointerId)[1];
      const apart = (one) => Math.hypot(one.offsetX - other.offsetX, one.offsetY - other.offsetY);
      const middle = [(event.offsetX + other.offsetX) / 2, (event.offsetY + other.offsetY) / 2];
      this.zoomBy(apart(event) / Math.max(apart(before), 1), ...middle);
    }
    pointers.set(event.pointerId, event);
  }

  keyPressed(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const moves = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (moves[event.key]) this.step(...moves[event.key]);
    else if (event.key === "+" || event.key === "=") this.zoomBy(1.5);
    else if (event.key === "-") this.zoomBy(1 / 1.5);
    else if (event.key === "0") this.fit();
    else if (event.key === "f") this.nextFailed();
    else return;
    event.preventDefault();
  }
}

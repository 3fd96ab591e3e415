// Where the parts of a state diagram go. States lie on an ellipse, the initial state on top; each arrow has its label beside it.

const CHAR = 7.3; // width of a character of the font, in units of the drawing
const BOX_H = 36;
const LINE_H = 15;
const LABEL_CHARS = 24;
const EXPANDED = 4; // transitions from any state are drawn from each state up to this number of states

export const wrapped = (text, most = LABEL_CHARS) => {
  const lines = [];
  for (const word of text.split(" ")) {
    const last = lines[lines.length - 1];
    if (last !== undefined && last.length + word.length < most) lines[lines.length - 1] = `${last} ${word}`;
    else lines.push(word);
  }
  return lines.map((line) => (line.length > most + 8 ? `${line.slice(0, most + 7)}…` : line));
};

/** Arrows by source and target, with their labels. `seen`: [source, target] of transitions that were observed. */
export function arrowsOf(machine, seen) {
  const found = new Map();
  const add = (source, target, label) => {
    const key = JSON.stringify([source, target]);
    if (!found.has(key)) found.set(key, { source, target, labels: [] });
    if (label && !found.get(key).labels.includes(label)) found.get(key).labels.push(label);
  };
  for (const { source, target, label } of machine.transitions) {
    if (source) add(source, target, label);
    else if (machine.states.length > EXPANDED) add("", target, label);
    else for (const state of machine.states) if (state !== target) add(state, target, label);
  }
  if (!machine.declared) for (const [source, target] of seen) add(source, target, "");
  return [...found.values()].filter((a) => machine.states.includes(a.target) && (!a.source || machine.states.includes(a.source)));
}

/** Places of boxes, arrows and labels: {width, height, boxes, arrows, start}. */
export function layout(machine, arrows) {
  const names = machine.initial ? [machine.initial, ...machine.states.filter((s) => s !== machine.initial)] : machine.states;
  const texts = arrows.map((a) => a.labels.flatMap((label) => wrapped(a.source ? label : `from any state: ${label}`)));
  const longest = CHAR * Math.max(0, ...texts.flat().map((line) => line.length));
  const boxW = (name) => Math.max(76, name.length * CHAR + 26);
  const widest = Math.max(...names.map(boxW));
  const n = names.length;
  const rx = n === 1 ? 0 : Math.max(150, ((longest + widest) * n) / 7);
  const ry = n === 1 ? 0 : Math.max(105, (Math.max(...texts.map((t) => t.length), 1) * LINE_H + 70) * (n / 5), rx * 0.35);
  const margin = 18 + longest / 2;
  const cx = rx + widest / 2 + margin;
  const cy = ry + BOX_H / 2 + 46;
  const boxes = Object.fromEntries(
    names.map((name, k) => {
      const angle = (2 * Math.PI * k) / n;
      return [name, { x: cx + rx * Math.sin(angle), y: cy - ry * Math.cos(angle), w: boxW(name), h: BOX_H }];
    }),
  );
  const taken = Object.values(boxes).map((b) => [b.x - b.w / 2 - 4, b.y - b.h / 2 - 4, b.x + b.w / 2 + 4, b.y + b.h / 2 + 4]);
  const boxCount = taken.length;
  const drawn = arrows.map((arrow, k) => {
    const opposite = arrows.some((a) => a.source === arrow.target && a.target === arrow.source);
    const curve = curveOf(boxes[arrow.source], boxes[arrow.target], opposite, cx, cy);
    return { ...arrow, ...curve, lines: texts[k] };
  });
  for (const arrow of drawn) {
    const others = drawn.filter((a) => a !== arrow).flatMap((a) => ALONG.map((t) => at(a.points, t)));
    if (arrow.lines.length) arrow.label = place(arrow, taken, boxCount, others);
  }
  const ends = drawn.flatMap((a) => ALONG.map((t) => at(a.points, t))).map(([x, y]) => [x, y, x, y]);
  const frames = [...taken, ...ends];
  const low = (side) => Math.min(...frames.map((f) => f[side]));
  const high = (side) => Math.max(...frames.map((f) => f[side]));
  const view = [low(0) - 30, Math.min(low(1), machine.initial ? boxes[names[0]].y - 62 : low(1)) - 8, 0, 0];
  view[2] = high(2) + 30 - view[0];
  view[3] = high(3) + 24 - view[1];
  return { view, boxes, arrows: drawn, initial: machine.initial ? boxes[machine.initial] : null };
}

/** The point at which a line from the middle of a box towards (x, y) leaves it. */
function edge(box, x, y) {
  const dx = x - box.x;
  const dy = y - box.y;
  const length = Math.hypot(dx, dy) || 1;
  const across = dx ? (box.w / 2 / Math.abs(dx)) * length : Infinity;
  const up = dy ? (box.h / 2 / Math.abs(dy)) * length : Infinity;
  const far = Math.min(across, up) + 3;
  return [box.x + (dx / length) * far, box.y + (dy / length) * far];
}

function curveOf(from, to, opposite, cx, cy) {
  if (!from) {
    // from any state: a short arrow from the outside of the ellipse
    const out = Math.sign(to.x - cx) || 1;
    const start = [to.x + out * (to.w / 2 + 46), to.y];
    return { points: [start, [to.x + out * (to.w / 2 + 20), to.y], [to.x + out * (to.w / 2 + 3), to.y]] };
  }
  if (from === to) {
    const out = from.y < cy ? -1 : 1;
    const control = [from.x + from.w / 2 + 34, from.y + out * 50];
    return { points: [[from.x + from.w / 2 + 3, from.y], control, [from.x + from.w / 4, from.y + out * (from.h / 2 + 3)]] };
  }
  const dx = to.x - from.x;
  const dy = to.y - from.y;
  const length = Math.hypot(dx, dy);
  const sway = opposite ? Math.max(46, length * 0.2) : 0; // two opposite arrows each bend to their left
  const control = [(from.x + to.x) / 2 + (dy / length) * sway, (from.y + to.y) / 2 - (dx / length) * sway];
  return { points: [edge(from, ...control), control, edge(to, ...control)] };
}

const on = ([a, b, c], t) => (1 - t) ** 2 * a + 2 * t * (1 - t) * b + t ** 2 * c;
const at = (points, t) => [on(points.map((p) => p[0]), t), on(points.map((p) => p[1]), t)];
const ALONG = Array.from({ length: 21 }, (_, n) => n / 20);
const overlap = (a, b) => Math.max(0, Math.min(a[2], b[2]) - Math.max(a[0], b[0])) * Math.max(0, Math.min(a[3], b[3]) - Math.max(a[1], b[1]));

/** The place of a label along its arrow at which it covers no box, and as little as possible of other labels and arrows. */
function place({ points, lines }, taken, boxCount, others) {
  const w = Math.max(...lines.map((line) => line.length)) * CHAR + 8;
  const h = lines.length * LINE_H + 4;
  let best = null;
  for (const t of [0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8]) {
    for (const [ox, oy] of [[0, 0], [0, -h / 2], [0, h / 2], [-w / 2 - 4, 0], [w / 2 + 4, 0], [0, -h - 8], [0, h + 8], [w / 2 + 4, h], [-w / 2 - 4, h], [w / 2 + 4, -h], [-w / 2 - 4, -h], [0, -1.5 * h - 12], [0, 1.5 * h + 12], [w, 0], [-w, 0]]) {
      const [x, y] = at(points, t).map((place, n) => place + [ox, oy][n]);
      const frame = [x - w / 2, y - h / 2, x + w / 2, y + h / 2];
      const cost =
        others.filter(([px, py]) => px > frame[0] && px < frame[2] && py > frame[1] && py < frame[3]).length * 60 +
        taken.reduce((sum, other, k) => sum + overlap(frame, other) * (k < boxCount ? 200 : 2), 0) + Math.hypot(ox, oy) * 0.5 + Math.abs(t - 0.5) * 20;
      if (!best || cost < best.cost) best = { cost, frame, x, y, w, h };
    }
  }
  taken.push(best.frame);
  return best;
}

/** An arrow's head at its end, as the points of a polygon. */
export function tip([, control, end]) {
  const angle = Math.atan2(end[1] - control[1], end[0] - control[0]);
  const side = (turn) => `${(end[0] - 9 * Math.cos(angle + turn)).toFixed(1)},${(end[1] - 9 * Math.sin(angle + turn)).toFixed(1)}`;
  return `${end[0].toFixed(1)},${end[1].toFixed(1)} ${side(0.4)} ${side(-0.4)}`;
}

export const path = (points) => `M${points[0].map(Math.round)} Q${points[1].map(Math.round)} ${points[2].map(Math.round)}`;
export const lineHeight = LINE_H;

// A timeline that is zoomed and moved, as a Vue component and for a file of its own. It needs no other file.
const STEPS = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800,
  3600, 7200, 10800, 21600, 43200, 86400];
const ROW = 32, RIGHT = 36, TICK_PX = 96, BAR_PX = 3, MARK_PX = 15, LETTER_PX = 7, LEAST_S = 0.005, TOLD = 200, SPARE = 4;
const HINT = "Drag or ← → to move, wheel or + − to zoom, Home and End, 0 for all. Click a mark, or n and p: it says why.";
const escaped = (text) => String(text).replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
const two = (number) => String(number).padStart(2, "0");

function labelOf(counts, order) { // how many of the worst kind, and "+" if there are others; "" for one event
  const kinds = Object.keys(counts), count = counts[order.find((kind) => counts[kind])];
  const number = count === 1 ? "" : count < 1000 ? `${count}` : `${Math.floor(count / 1000)}k`;
  return number + (kinds.length > 1 ? "+" : "");
}

function mergedMarks(marks, perPx, order) { // a mark and the count beside it lie on no other one
  const groups = [];
  for (const mark of marks) {
    let last = groups[groups.length - 1];
    if (!last || mark[0] - last.at >= (MARK_PX + LETTER_PX * last.label.length) * perPx) {
      groups.push((last = { at: mark[0], counts: {}, marks: [] }));
    }
    last.marks.push(mark);
    for (const kind in mark[3]) last.counts[kind] = (last.counts[kind] || 0) + mark[3][kind];
    last.label = labelOf(last.counts, order);
  }
  return groups.map((group) => {
    const kinds = order.filter((kind) => group.counts[kind]);
    return { ...group, kind: kinds[0], kinds };
  });
}

function mergedBars(bars, step) {
  const found = [];
  for (const bar of bars) {
    const last = found[found.length - 1];
    if (last && last[0] !== null && bar[2] !== null && bar[2] - last[0] < step) {
      const count = last[4] + bar[4];
      found[found.length - 1] = [last[0], last[1], bar[2], bar[3], count, `${count} lives`];
    } else found.push(bar);
  }
  return found;
}

function clock(at, step) {
  const then = new Date(Math.round(at * 1000));
  if (step >= 86400) return `${then.getFullYear()}-${two(then.getMonth() + 1)}-${two(then.getDate())}`;
  const text = `${two(then.getHours())}:${two(then.getMinutes())}`;
  if (step >= 60) return text;
  const seconds = `${text}:${two(then.getSeconds())}`;
  return step >= 1 ? seconds : `${seconds}.${String(then.getMilliseconds()).padStart(3, "0")}`;
}

export class TimelineView {
  constructor(host, looks) {
    this.host = host;
    this.looks = looks;
    this.order = Object.keys(looks);
    this.data = { subject: "", since: 0, until: 1, left_out: 0, lanes: [] };
    this.view = null; // [since, until]; null shows all
    this.follows = true; // the view's end moves with the newest event
    this.chosen = null;
    host.innerHTML = `
      <div class="rr-tl-bar"><span class="rr-tl-subject"></span>
        <button type="button" data-do="Home" title="Home">beginning</button><button type="button" data-do="-" aria-label="zoom out">−</button>
        <button type="button" data-do="+" aria-label="zoom in">+</button><button type="button" data-do="0" title="0">all</button>
        <button type="button" data-do="End" title="End">now</button></div>
      <div class="rr-tl-plot" tabindex="0" role="application" aria-label="timeline"><svg class="rr-tl rr-tl-axis" height="30"></svg>
        <svg class="rr-tl rr-tl-lanes"></svg></div>
      <div class="rr-tl-legend"></div><pre class="rr-tl-why" role="status" aria-live="polite">${HINT}</pre>`;
    const find = (name) => host.querySelector(`.rr-tl-${name}`);
    [this.plot, this.axis, this.lanes, this.why] = ["plot", "axis", "lanes", "why"].map(find);
    [this.subject, this.legend] = ["subject", "legend"].map(find);
    host.querySelectorAll("button").forEach((one) => one.addEventListener("click", () => this.press(one.dataset.do)));
    this.plot.addEventListener("keydown", (event) => {
      if (!event.ctrlKey && !event.metaKey && !event.altKey && this.press(event.key)) event.preventDefault();
    });
    this.plot.addEventListener("scroll", () => this.draw());
    this.plot.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.plot.addEventListener("dblclick", (event) => this.zoom(0.5, this.time(event)));
    this.plot.addEventListener("pointerdown", (event) => this.down(event));
    this.plot.addEventListener("pointermove", (event) => this.move(event));
    this.plot.addEventListener("pointerup", (event) => this.up(event));
    this.plot.addEventListener("pointercancel", () => (this.drag = null));
    this.size = new ResizeObserver(() => this.draw());
    this.size.observe(this.plot);
  }

  close() { this.size.disconnect(); }

  show(data) {
    const span = this.view && this.view[1] - this.view[0];
    this.data = data;
    this.shownAt = performance.now();
    const used = new Set(data.lanes.flatMap((lane) => lane.marks.flatMap((mark) => Object.keys(mark[3]))));
    this.legend.innerHTML = this.order.filter((kind) => used.has(kind)).map((kind) => `<span><svg class="rr-tl" width="16"
      height="16"><path class="mark k-${kind}" transform="translate(8 8)" d="${this.looks[kind][1]}"/></svg>${escaped(this.looks[kind][0])}</span>`).join("");
    if (this.view && this.follows) this.view = [data.until - span, data.until];
    this.draw();
  }

  advance() { // lives go on although nothing happens
    const { data, shownAt } = this, span = this.view && this.view[1] - this.view[0];
    this.shownAt = performance.now();
    data.until += (this.shownAt - shownAt) / 1000;
    if (this.view && this.follows) this.view = [data.until - span, data.until];
    if (!this.drag && (!this.view || this.follows)) this.draw();
  }

  get range() { return this.view || [this.data.since, this.data.until]; }
  get label() { return Math.min(210, Math.round(this.plot.clientWidth * 0.28)); }
  get width() { return Math.max(40, this.plot.clientWidth - this.label - RIGHT); }
  x(at) { const [a, b] = this.range; return this.label + Math.min(1, Math.max(0, (at - a) / (b - a))) * this.width; }
  time(event) {
    const [a, b] = this.range;
    return a + ((event.clientX - this.plot.getBoundingClientRect().left - this.label) / this.width) * (b - a);
  }

  press(key) {
    const [a, b] = this.range, span = b - a, all = this.data;
    const keys = {
      ArrowLeft: () => this.look(a - span / 8, b - span / 8), ArrowRight: () => this.look(a + span / 8, b + span / 8),
      "+": () => this.zoom(0.5), "=": () => this.zoom(0.5), "-": () => this.zoom(2), 0: () => this.look(all.since, all.until),
      Home: () => this.look(all.since, all.since + span), End: () => this.look(all.until - span, all.until),
      n: () => this.step(1), p: () => this.step(-1),
    };
    if (keys[key]) keys[key]();
    return Boolean(keys[key]);
  }

  zoom(factor, at) {
    const [a, b] = this.range;
    const fixed = at === undefined ? (this.view && this.follows ? b : (a + b) / 2) : Math.min(b, Math.max(a, at));
    const span = Math.max(LEAST_S, (b - a) * factor);
    const before = ((fixed - a) / (b - a)) * span;
    this.look(fixed - before, fixed - before + span);
  }

  look(since, until) { // as near to that as there is something to see
    const { since: first, until: last } = this.data, span = Math.min(until - since, last - first);
    const begin = Math.min(Math.max(since, first), last - span);
    this.view = span >= last - first ? null : [begin, begin + span];
    this.follows = begin + span >= last - span / 1000;
    this.draw();
  }

  wheel(event) {
    if (event.clientX - this.plot.getBoundingClientRect().left < this.label) return; // names scroll up and down
    event.preventDefault();
    if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) {
      const [a, b] = this.range, by = (event.deltaX / this.width) * (b - a);
      this.look(a + by, b + by);
    } else this.zoom(Math.exp(Math.max(-2, Math.min(2, event.deltaY / 400))), this.time(event));
  }

  down(event) {
    if (event.button) return;
    const item = event.target.closest("[data-item]");
    this.drag = { x: event.clientX, range: this.range, item: item && this.items[item.dataset.item], moved: false };
    this.plot.setPointerCapture(event.pointerId);
  }

  move(event) {
    if (!this.drag) return;
    const by = event.clientX - this.drag.x;
    if (Math.abs(by) > 3) this.drag.moved = true;
    if (!this.drag.moved) return;
    const [a, b] = this.drag.range, shift = (-by / this.width) * (b - a);
    this.look(a + shift, b + shift);
  }

  up() {
    const drag = this.drag;
    this.drag = null;
    if (drag && !drag.moved && drag.item) this.choose(drag.item);
  }

  step(by) { // to the next or previous mark
    const marks = this.items.filter((item) => item.kind).sort((one, other) => one.at - other.at || (one.path < other.path ? -1 : 1));
    const here = marks.findIndex((item) => this.isChosen(item));
    const next = marks[here < 0 ? (by > 0 ? 0 : marks.length - 1) : here + by];
    if (next) this.choose(next);
  }

  isChosen(item) { const c = this.chosen; return c && c.path === item.path && c.at === item.at && c.kind === item.kind; }

  choose(item) {
    this.chosen = item;
    if (item.kind) {
      const texts = item.marks.flatMap((mark) => mark[2].split("\n").slice(mark[2].includes("\n") ? 1 : 0));
      const worst = item.marks.filter((mark) => mark[1] === item.kind).map((mark) => mark[2]);
      const counts = item.kinds.map((kind) => `${item.counts[kind]} × ${this.looks[kind][0]}`).join(", ");
      const shown = texts.length <= TOLD ? texts : [...new Set([...worst, ...texts])].slice(0, TOLD);
      const more = texts.length > shown.length ? [`… zoom in for the others`] : [];
      this.why.textContent = item.marks.length > 1 ? [`${item.path}: ${counts}`, ...shown, ...more].join("\n") : item.marks[0][2];
    } else this.why.textContent = item.text;
    this.draw();
  }

  draw() {
    if (!this.plot.clientWidth) return; // it is not visible
    const [a, b] = this.range, perPx = (b - a) / this.width, out = [];
    this.items = [];
    const top = Math.max(0, Math.floor(this.plot.scrollTop / ROW) - SPARE); // only the lanes that are visible, and a few
    const below = top + Math.ceil(Math.max(this.plot.clientHeight, ROW * SPARE) / ROW) + 2 * SPARE;
    this.data.lanes.slice(top, below).forEach((lane, number) => out.push(this.lane(lane, (top + number) * ROW, a, b, perPx)));
    const height = Math.max(ROW, this.data.lanes.length * ROW), width = this.plot.clientWidth;
    const step = STEPS.find((one) => one / perPx >= TICK_PX) || 86400 * Math.ceil((TICK_PX * perPx) / 86400);
    const offset = -new Date(a * 1000).getTimezoneOffset() * 60;
    let axis = "", grid = "";
    for (let n = Math.ceil((a + offset) / step); n * step - offset <= b; n++) {
      const at = n * step - offset, x = this.x(at).toFixed(1);
      grid += `<line class="grid" x1="${x}" x2="${x}" y1="0" y2="${height}"/>`;
      if (x < width - 42) axis += `<text class="dim small" x="${x}" y="20" text-anchor="middle">${clock(at, step)}</text>`;
    }
    this.axis.setAttribute("width", width);
    this.axis.innerHTML = `<rect class="back" width="100%" height="100%"/>${axis}`;
    this.lanes.setAttribute("width", width);
    this.lanes.setAttribute("height", height);
    this.lanes.innerHTML = `<rect class="back" width="100%" height="100%"/>${grid}${out.join("")}`;
    const count = this.data.left_out;
    const left = count ? `, left out: ${count} lane${count === 1 ? "" : "s"} with less trouble` : "";
    this.subject.textContent = this.data.subject + left;
    this.host.dataset.since = a;
    this.host.dataset.until = b;
  }

  lane(lane, y, a, b, perPx) {
    const depth = Math.min(6, lane.path.split("/").length - 1), x = 8 + (this.label < 180 ? 7 : 14) * depth;
    const name = lane.path.slice(lane.path.lastIndexOf("/") + 1), room = Math.max(3, Math.floor((this.label - x - 8) / 7));
    const short = name.length <= room ? name : `${name.slice(0, room >> 1)}…${name.slice(name.length - (room - 1 - (room >> 1)))}`;
    const bold = lane.kind === "supervisor" ? ' font-weight="700"' : "";
    let out = `<line class="grid" x1="0" x2="100%" y1="${y + ROW}" y2="${y + ROW}"/>
      <text x="${x}" y="${y + 16}"${bold}>${escaped(short)}<title>${escaped(lane.path)}</title></text>`;
    for (const bar of mergedBars(lane.bars, BAR_PX * perPx)) {
      const [begin, ready, end, how, count, text] = bar;
      const from = begin === null ? this.data.since : begin, to = end === null ? this.data.until : end;
      if (to < a || from > b) continue;
      const left = this.x(from), right = this.x(to), item = this.items.push({ path: lane.path, at: from, text }) - 1;
      const looks = `bar${count > 1 ? " many" : ""}${how === "unknown" ? " unknown" : ""}`;
      const rect = (cls, to) => `<rect class="${cls}" x="${left.toFixed(1)}" y="${y + 6}" width="${Math.max(1.5, to - left).toFixed(1)}" height="12" rx="2"/>`;
      const starting = ready !== null && count === 1 && this.x(ready) > left + 1 ? rect("bar starting", this.x(ready)) : "";
      out += `<g data-item="${item}">${rect(looks, right)}${starting}<title>${escaped(text)}</title></g>`;
    }
    for (const [ofChildren, at] of [[true, y + 12], [false, y + 25]]) {
      const marks = lane.marks.filter((mark) => this.looks[mark[1]][2] === ofChildren);
      for (const mark of mergedMarks(marks, perPx, this.order)) {
        if (mark.at >= a && mark.at <= b) out += this.mark({ path: lane.path, ...mark }, at);
      }
    }
    return out;
  }

  mark(item, y) {
    const number = this.items.push(item) - 1, x = this.x(item.at);
    const ring = this.isChosen(item) ? `<circle class="ring" cx="${x.toFixed(1)}" cy="${y}" r="9"/>` : "";
    return `<g class="rr-tl-mark" data-item="${number}" data-kind="${item.kind}" data-path="${escaped(item.path)}">
      <rect class="touch" x="${(x - 7).toFixed(1)}" y="${y - 7}" width="14" height="14"/>
      <path class="mark k-${item.kind}" transform="translate(${x.toFixed(1)} ${y})" d="${this.looks[item.kind][1]}"/>
      ${item.label && `<text class="count" x="${(x + 8).toFixed(1)}" y="${y + 3}">${item.label}</text>`}${ring}
      <title>${escaped(item.marks.length > 1 ? "" : item.marks[0][2])}</title></g>`;
  }
}

export default {
  props: { data: String, looks: Object, live: Boolean },
  template: `<div class="rr-tl rr-tl-host"></div>`,
  mounted() {
    this.shown = new TimelineView(this.$el, JSON.parse(JSON.stringify(this.looks)));
    if (this.data) this.shown.show(JSON.parse(this.data));
    this.clock = setInterval(() => this.live && this.shown.advance(), 1000);
  },
  unmounted() { this.shown.close(); clearInterval(this.clock); },
  watch: { data(text) { this.shown.show(JSON.parse(text)); } },
};

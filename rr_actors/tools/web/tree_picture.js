// A supervisor tree from left to right. Vue redraws only the nodes that have changed, so the focus stays on its node.
const SIGNS = { running: "●", starting: "◔", restarting: "↻", stopped: "■", unavailable: "✖" };

const Branch = {
  name: "rr-branch",
  props: ["node", "chosen", "focus", "unknown"],
  emits: ["pick"],
  template: `
    <li role="none">
      <button type="button" role="treeitem" class="rr-node" :class="[unknown ? 'rr-unknown' : 'rr-' + node.state, { 'rr-chosen': node.path === chosen }]"
        :data-path="node.path" :aria-selected="node.path === chosen" :aria-label="label"
        :tabindex="node.path === focus ? 0 : -1" :title="node.error || node.note || node.type" @click="$emit('pick', node.path)">
        <span class="rr-id"><span class="rr-sign" aria-hidden="true">{{ sign }}</span> {{ node.id }}</span>
        <span v-if="node.restarts" class="rr-count" :key="node.restarts">↻{{ node.restarts }}</span>
        <span class="rr-fact">{{ unknown || node.state }}{{ node.pid && !unknown ? ' · ' + node.pid : '' }}</span>
        <span v-if="node.note && !unknown" class="rr-fact">⚠ see below</span>
        <span v-if="node.strategy" class="rr-fact">{{ node.strategy }}</span>
        <span v-if="node.type === 'supervisor'" class="rr-window" :title="windowText">
          <i v-for="n in slots" :key="n" :class="{ full: n <= node.recent, over: n > node.most }"></i>
          <em>{{ node.recent }}/{{ node.most }}</em>
        </span>
      </button>
      <ul v-if="node.children.length" role="group">
        <rr-branch v-for="child in node.children" :key="child.path" :node="child" :chosen="chosen" :focus="focus" :unknown="unknown"
          @pick="$emit('pick', $event)"></rr-branch>
      </ul>
    </li>`,
  computed: {
    sign() { return (!this.unknown && SIGNS[this.node.state]) || "?"; },
    slots() { return Math.min(12, Math.max(this.node.most, this.node.recent)); },
    windowText() { return `${this.node.recent} restarts in the window, ${this.node.most} allowed`; },
    label() {
      const restarts = this.node.restarts ? `, restarted ${this.node.restarts} times` : "";
      const window = this.node.type === "supervisor" ? `, ${this.windowText}` : "";
      const note = this.node.note ? `, ${this.node.note}` : "";
      return `${this.node.path}, ${this.unknown || this.node.state}${restarts}${window}${note}`;
    },
  },
};

export default {
  components: { "rr-branch": Branch },
  props: { rows: Array, chosen: String, unknown: String },
  template: `
    <ul role="tree" class="rr-tree" aria-label="supervisor tree" @keydown="move">
      <rr-branch v-for="root in roots" :key="root.path" :node="root" :chosen="chosen" :focus="focus" :unknown="unknown"
        @pick="pick"></rr-branch>
    </ul>`,
  data() { return { at: "" }; },
  computed: {
    focus() {
      const known = (path) => path && this.rows.some((row) => row.path === path);
      return known(this.at) ? this.at : known(this.chosen) ? this.chosen : this.rows.length ? this.rows[0].path : "";
    },
    roots() {
      const nodes = new Map();
      const roots = [];
      for (const row of this.rows) {
        const node = { ...row, children: [] };
        nodes.set(row.path, node);
        const above = nodes.get(row.path.slice(0, row.path.lastIndexOf("/")));
        (above ? above.children : roots).push(node);
      }
      return roots;
    },
  },
  methods: {
    pick(path) {
      this.at = path;
      this.$emit("pick", path);
    },
    move(event) {
      const paths = this.rows.map((row) => row.path);
      const above = (path) => path.slice(0, path.lastIndexOf("/"));
      const place = paths.indexOf(this.focus);
      const to = {
        ArrowDown: paths[place + 1],
        ArrowUp: paths[place - 1],
        ArrowLeft: above(this.focus),
        ArrowRight: paths.find((path) => above(path) === this.focus),
        Home: paths[0],
        End: paths[paths.length - 1],
      }[event.key];
      if (!(event.key.startsWith("Arrow") || event.key === "Home" || event.key === "End")) return;
      event.preventDefault();
      if (!to || !paths.includes(to)) return;
      this.at = to;
      this.$nextTick(() => this.$el.querySelector(`[data-path="${CSS.escape(to)}"]`).focus());
    },
  },
};

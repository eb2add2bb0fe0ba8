// HTML that changes in place: an element that stays keeps its focus, its hover, and a click that has begun.
function patch(now, wanted) {
  if (now.nodeType !== wanted.nodeType || now.nodeName !== wanted.nodeName || now.dataset?.key !== wanted.dataset?.key) {
    now.replaceWith(wanted);
  } else if (now.nodeType === Node.TEXT_NODE) {
    if (now.data !== wanted.data) now.data = wanted.data;
  } else {
    for (const { name } of [...now.attributes]) if (!wanted.hasAttribute(name)) now.removeAttribute(name);
    for (const { name, value } of wanted.attributes) if (now.getAttribute(name) !== value) now.setAttribute(name, value);
    patchAll(now, wanted);
  }
}

function patchAll(now, wanted) {
  const parts = [...wanted.childNodes];
  while (now.childNodes.length > parts.length) now.lastChild.remove();
  parts.forEach((part, at) => (at < now.childNodes.length ? patch(now.childNodes[at], part) : now.append(part)));
}

export default {
  props: { content: String },
  template: `<div @click="act"></div>`,
  mounted() { this.draw(); },
  watch: { content() { this.draw(); } },
  methods: {
    draw() {
      const wanted = document.createElement("template");
      wanted.innerHTML = this.content;
      patchAll(this.$el, wanted.content);
    },
    act(event) {
      const button = event.target.closest("button[data-act]");
      if (button) this.$emit("act", [button.dataset.act, button.dataset.of || ""]);
    },
  },
};

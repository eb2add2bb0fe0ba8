// The frame of a page: what is chosen is in its address, the keys, and the palette of names.
(() => {
  const KINDS = ["child", "resource", "server", "registrar"];
  const narrow = matchMedia("(max-width: 1100px)");
  const prefix = () => window.path_prefix || "";
  const main = () => document.querySelector(".rr-main");
  const drawer = () => document.querySelector(".rr-drawer");

  function carry() { // the choice and the time go on to the other pages
    const now = new URLSearchParams(location.search), kept = new URLSearchParams();
    for (const name of [...KINDS, "at", "events"]) if (now.has(name)) kept.set(name, now.get(name));
    for (const link of document.querySelectorAll(".rr-nav a[data-page]")) {
      link.href = link.href.split("?")[0] + (kept.size ? `?${kept}` : "");
    }
  }

  function cover() { // a drawer that covers the work takes the keys, too
    const isOpen = drawer() && drawer().classList.contains("rr-open");
    if (main()) main().inert = Boolean(isOpen && narrow.matches);
  }

  function tell() { emitEvent("rr_address", Object.fromEntries(new URLSearchParams(location.search))); }

  function choose(search) {
    const now = new URLSearchParams(location.search), wanted = new URLSearchParams(search);
    KINDS.forEach((kind) => now.delete(kind));
    for (const kind of KINDS) if (wanted.get(kind)) now.set(kind, wanted.get(kind));
    history.pushState(null, "", now.size ? `?${now}` : location.pathname);
    carry();
    tell();
  }

  window.rrFrame = {
    address(query, push) { // what the server shows
      const now = new URLSearchParams(query), text = now.size ? `?${now}` : location.pathname;
      if (`?${now}` !== (location.search || "?")) history[push ? "pushState" : "replaceState"](null, "", text);
      carry();
    },
    opened(isOpen) {
      const was = drawer().classList.contains("rr-open");
      drawer().classList.toggle("rr-open", isOpen);
      cover();
      if (isOpen && !was && narrow.matches) drawer().focus();
    },
  };
  narrow.addEventListener("change", cover);
  addEventListener("popstate", () => { carry(); tell(); });
  addEventListener("DOMContentLoaded", () => setTimeout(() => { carry(); cover(); }));

  document.addEventListener("click", (event) => {
    const link = event.target.closest("a[data-choose]");
    if (link && !event.ctrlKey && !event.metaKey && !event.shiftKey && event.button === 0) {
      event.preventDefault();
      choose(new URL(link.href).search);
    } else if (event.target.closest("[data-close]") || (main() && main().inert && event.target.closest(".rr-frame")
      && !event.target.closest(".rr-drawer, .rr-nav"))) choose("");
    else if (event.target.closest("[data-keys]")) help();
  });

  function dialog(label) {
    const made = document.createElement("dialog");
    made.className = "rr-dialog";
    made.setAttribute("aria-label", label);
    made.addEventListener("close", () => made.remove());
    made.addEventListener("click", (event) => { if (event.target === made) made.close(); });
    document.body.append(made);
    return made;
  }

  function help() {
    const made = dialog("keys"), rows = [["/", "search a name or a page"], ["j k", "next and previous row"],
      ["Enter", "choose the row"], ["Esc", "close the drawer"], ["?", "these keys"]];
    const rowsHtml = rows.map(([key, text]) => `<dt>${key.split(" ").map((k) => `<kbd>${k}</kbd>`).join(" ")}</dt><dd>${text}</dd>`);
    made.innerHTML = `<h2>Keys</h2><dl>${rowsHtml.join("")}</dl>`;
    made.tabIndex = -1;
    made.showModal();
  }

  function palette() {
    const made = dialog("search"), input = document.createElement("input"), list = document.createElement("ul");
    Object.assign(input, { placeholder: "A child, a resource, a server, a page", autocomplete: "off" });
    for (const [name, value] of [["role", "combobox"], ["aria-label", "search"], ["aria-controls", "rr-found"],
      ["aria-expanded", "true"]]) input.setAttribute(name, value);
    list.id = "rr-found";
    list.setAttribute("role", "listbox");
    list.setAttribute("aria-label", "found");
    made.append(input, list);
    let found = [], at = 0, asked = 0;
    const draw = () => {
      list.replaceChildren(...found.map((one, place) => {
        const row = document.createElement("li"), kind = document.createElement("span");
        row.id = `rr-found-${place}`;
        row.setAttribute("role", "option");
        row.setAttribute("aria-selected", place === at);
        row.append(one.name);
        kind.className = "rr-note";
        kind.append(one.kind);
        row.append(kind);
        row.onclick = () => go(one);
        return row;
      }));
      input.setAttribute("aria-activedescendant", found.length ? `rr-found-${at}` : "");
      list.children[at]?.scrollIntoView({ block: "nearest" });
    };
    const go = (one) => {
      made.close();
      if (one.kind === "page") location.href = prefix() + one.href + location.search;
      else choose(one.href);
    };
    const ask = async () => {
      const mine = ++asked;
      const answer = await fetch(`${prefix()}/names?match=${encodeURIComponent(input.value)}`).catch(() => null);
      const rows = answer && answer.ok ? await answer.json() : [];
      if (mine !== asked) return;
      found = rows;
      at = 0;
      draw();
    };
    input.oninput = ask;
    input.onkeydown = (event) => {
      const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (step && found.length) { event.preventDefault(); at = (at + step + found.length) % found.length; draw(); }
      if (event.key === "Enter" && found[at]) { event.preventDefault(); go(found[at]); }
    };
    made.showModal();
    input.focus();
    ask();
  }

  function step(way) { // j and k: in a tree and in a grid, arrows do it; else the rows take the focus one after the other
    const here = document.activeElement, arrow = way > 0 ? "ArrowDown" : "ArrowUp";
    if (here.closest("[role=treeitem], .ag-row, .ag-cell")) {
      here.dispatchEvent(new KeyboardEvent("keydown", { key: arrow, code: arrow, bubbles: true }));
      return;
    }
    const rows = [...main().querySelectorAll("a.rr-item, [role=treeitem][tabindex='0']")].filter((row) => row.checkVisibility());
    const grid = main().querySelector(".nicegui-aggrid");
    if (!rows.length && grid) {
      const api = getElement(grid.id.slice(1)).api;
      api.ensureIndexVisible(0);
      api.setFocusedCell(0, api.getAllDisplayedColumns()[0]);
    } else if (rows.length) {
      const at = rows.indexOf(here);
      rows[at < 0 ? 0 : Math.min(rows.length - 1, Math.max(0, at + way))].focus();
    }
  }

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open], .q-dialog")) return;
    if (event.key === "Escape" && drawer()?.classList.contains("rr-open")) return choose("");
    if (event.target.closest?.("input, textarea, select, [contenteditable=true], .cm-editor")) return;
    if (!drawer()) return;
    const keys = { "/": palette, "?": help, j: () => step(1), k: () => step(-1) };
    if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
  });
})();

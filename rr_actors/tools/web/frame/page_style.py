"""The looks of all pages: one set of colours for light and dark, type, space, the frame, and its parts."""

from __future__ import annotations

from rr_actors.base.notebook import escape

_COLOURS = """\
:root { color-scheme: light dark;
  --rr-back: light-dark(#f5f7f9, #0e1318); --rr-paper: light-dark(#fff, #161c23);
  --rr-raised: light-dark(#f0f3f6, #1f2730); --rr-edge: light-dark(#e0e5ea, #2a333d);
  --rr-outline: light-dark(#c3ccd5, #46525f); --rr-text: light-dark(#111923, #e6ebf0);
  --rr-dim: light-dark(#566372, #9dabb9); --rr-fact: light-dark(#4a5765, #a8b5c2);
  --rr-focus: light-dark(#2156d4, #86abff); --rr-halo: light-dark(#a9c2f7, #35528f);
  --rr-good: light-dark(#1a7f4b, #57c78a); --rr-good-bar: light-dark(#bfe4cf, #245a3f);
  --rr-warm: light-dark(#df8b00, #f0a93a); --rr-warm-paper: light-dark(#fff4dc, #3b2d12);
  --rr-warm-bar: light-dark(#f8d9a4, #6d5117); --rr-amber: light-dark(#925400, #f2b755);
  --rr-bad: light-dark(#c01f1f, #ff857d); --rr-bad-paper: light-dark(#fdecea, #3d1c1c);
  --rr-bad-bar: light-dark(#f4b3b3, #7a2c2c); --rr-bad-edge: light-dark(#efc1bd, #6b2f2f);
  --rr-still: light-dark(#75818e, #93a0ad); --rr-still-paper: light-dark(#e8ebee, #272f38);
  --rr-unknown-paper: light-dark(#eceff2, #222a32); --rr-count: light-dark(#a63a00, #ff9a6b);
  --rr-nav: #111923; --rr-nav-here: #253242; --rr-nav-text: #c6d0da; --rr-nav-dim: #8b98a6;
  --rr-font: Inter, system-ui, "Segoe UI", Roboto, "Helvetica Neue", "DejaVu Sans", sans-serif; }
"""
_FRAME = """\
body { background: var(--rr-back); color: var(--rr-text); font: 14px/1.45 var(--rr-font);
  font-variant-numeric: tabular-nums;
  --q-primary: light-dark(#2156d4, #86abff) !important; --q-negative: #b71c1c !important;
  --q-positive: #1b6e2a !important; --q-warning: #8a5300 !important; }
.body--dark { background: var(--rr-back); }
.nicegui-content { padding: 0; gap: 0; } .q-loading-bar { display: none; }
.rr-frame { display: grid; grid-template: minmax(0, 1fr) / 208px minmax(0, 1fr) auto; width: 100%; height: 100dvh; }
.rr-nav { background: var(--rr-nav); color: #fff; padding: 16px 12px; display: flex; flex-direction: column; gap: 2px;
  overflow: auto; }
.rr-nav .rr-who { padding: 0 10px 14px; min-width: 0; }
.rr-nav .rr-name { font-size: 16px; font-weight: 650; overflow-wrap: anywhere; }
.rr-status { font-size: 12.5px; color: var(--rr-nav-dim); overflow-wrap: anywhere; }
.rr-status.rr-bad { color: #ffc0b8; font-weight: 600; }
.rr-nav a { display: flex; justify-content: space-between; align-items: center; gap: 8px; min-height: 32px;
  padding: 4px 10px; border-radius: 6px; color: var(--rr-nav-text); text-decoration: none; }
.rr-nav a:hover { background: #1b2633; } .rr-nav a.rr-here { background: var(--rr-nav-here); color: #fff; }
.rr-nav .rr-badge { font-size: 12px; font-weight: 500; padding: 0 8px; border-radius: 10px; background: #2b3846;
  color: #dde5ec; }
.rr-badge:empty { display: none; } .rr-badge.rr-bad { background: #c62828; color: #fff; font-weight: 650; }
.rr-nav .rr-help { margin-top: auto; padding: 8px 10px 0; font-size: 12px; color: var(--rr-nav-dim); }
.rr-main { overflow: auto; min-width: 0; display: flex; flex-direction: column; }
.rr-page { width: 100%; max-width: 2300px; padding: 16px 20px 24px; gap: 16px; }
.rr-title { font-size: 16px; font-weight: 650; line-height: 1.4; margin: 0; }
.rr-drawer { width: 380px; background: var(--rr-paper); border-left: 1px solid var(--rr-edge); overflow: auto;
  padding: 16px; animation: rr-slide 0.15s; }
.rr-drawer:not(.rr-open) { display: none; }
.rr-drawer:focus { outline: none; }
@keyframes rr-slide { from { transform: translateX(24px); opacity: 0; } }
.rr-close { float: right; width: 28px; height: 28px; border: none; background: none; color: var(--rr-dim);
  font-size: 18px; line-height: 1; cursor: pointer; border-radius: 6px; }
@media (max-width: 1100px) { .rr-frame { grid-template-columns: 208px minmax(0, 1fr); }
  .rr-drawer { position: fixed; z-index: 20; inset: 0 0 0 auto; max-width: 100vw; box-shadow: -8px 0 24px #0003; } }
@media (max-width: 800px) { .rr-frame { grid-template: minmax(0, 1fr) auto / minmax(0, 1fr); }
  .rr-nav { grid-row: 2; flex-direction: row; padding: 6px 8px; gap: 0; } .rr-nav .rr-help,
  .rr-nav .rr-name { display: none; }
  .rr-nav .rr-who { padding: 0; width: 1px; overflow: hidden; clip-path: inset(50%); white-space: nowrap;
  position: absolute; }
  .rr-nav a { flex: none; min-height: 44px; } .rr-page { padding: 12px; gap: 12px; } }
@media (prefers-reduced-motion: reduce) { *, ::before, ::after { animation: none !important;
  transition: none !important; } }
:is(a, button, input, [tabindex]):focus-visible { outline: 2px solid var(--rr-focus); outline-offset: 2px; }
.rr-nav a:focus-visible { outline-color: #86abff; outline-offset: -2px; }
"""
_PARTS = """\
.rr-panel, .rr-card { background: var(--rr-paper); border: 1px solid var(--rr-edge); border-radius: 10px;
  padding: 12px 16px; overflow: auto; min-width: 0; }
.rr-split { display: flex; width: 100%; gap: 16px; align-items: stretch; } .rr-split > .rr-panel { max-height: 62vh; }
.rr-holds-tree { container-type: inline-size; }
@media (max-width: 900px) { .rr-split { flex-direction: column; } .rr-split > .rr-panel { flex: none !important; } }
@media (prefers-color-scheme: dark) {
  .rr-graph canvas, .rr-sequence svg, .rr-actions svg { filter: invert(1) hue-rotate(180deg); } }
a.rr-link { color: inherit; text-decoration: none; border-bottom: 1px solid var(--rr-outline); }
a.rr-link:hover { color: var(--rr-focus); border-color: currentColor; }
.rr-note { color: var(--rr-dim); font-size: 12.5px; } .rr-panel > .rr-note { padding: 6px 0; }
.rr-sign { font-size: 10px; vertical-align: 1px; }
.rr-pill { display: inline-flex; align-items: center; gap: 5px; padding: 1px 8px; border-radius: 6px; font-size: 12px;
  font-weight: 650; background: var(--rr-still-paper); color: var(--rr-text); }
.rr-pill.rr-is-good .rr-sign { color: var(--rr-good); } .rr-pill.rr-is-bad { background: var(--rr-bad-paper);
  color: var(--rr-bad); } .rr-pill.rr-is-warm { background: var(--rr-warm-paper); color: var(--rr-amber); }
.rr-is-bad > .rr-sign { color: var(--rr-bad); } .rr-is-warm > .rr-sign { color: var(--rr-warm); }
.rr-is-good > .rr-sign { color: var(--rr-good); } .rr-is-still > .rr-sign { color: var(--rr-still); }
.rr-act { min-height: 28px; padding: 3px 11px; border-radius: 6px; border: 1px solid var(--rr-outline);
  cursor: pointer;
  background: var(--rr-paper); color: var(--rr-text); font: inherit; font-size: 13px; white-space: nowrap; }
.rr-act:hover { border-color: var(--rr-dim); } .rr-act:disabled { opacity: 0.5; cursor: default; }
.rr-act.rr-harmful { color: var(--rr-bad); border-color: var(--rr-bad-edge); }
.rr-act.rr-small { min-height: 22px; padding: 0 8px; font-size: 12px; }
a.rr-act { text-decoration: none; display: inline-flex; align-items: center; }
.q-btn.q-btn--dense { padding: 2px 10px; border-radius: 6px; } .rr-harmful { color: var(--rr-bad); }
.rr-drawer h2 { font-size: 16px; font-weight: 650; line-height: 1.35; margin: 6px 0 2px; overflow-wrap: anywhere; }
.rr-drawer h3, .rr-h3 { font-size: 13px; font-weight: 650; color: var(--rr-dim); line-height: 1.4;
  margin: 18px 0 6px; }
.rr-acts { display: flex; flex-wrap: wrap; gap: 8px; margin: 10px 0; }
.rr-facts { display: grid; grid-template-columns: 88px minmax(0, 1fr); gap: 4px 12px; margin: 8px 0 0;
  font-size: 13px; }
.rr-facts dt { color: var(--rr-dim); } .rr-facts dd { margin: 0; overflow-wrap: anywhere; }
.rr-facts code, .rr-log { font: 12px/1.5 ui-monospace, "DejaVu Sans Mono", monospace; }
.rr-chain { list-style: none; margin: 0; padding: 0; font-size: 13px; }
.rr-chain li { position: relative; padding: 3px 0 3px 20px; overflow-wrap: anywhere; }
.rr-chain li::before { content: ""; position: absolute; left: 4px; top: 0; bottom: 0;
  border-left: 2px solid var(--rr-edge); }
.rr-chain li > .rr-sign { position: absolute; left: 0; top: 5px; background: var(--rr-paper); line-height: 1;
  padding: 2px 0; }
.rr-chain a.rr-link { display: inline-block; max-width: 100%; }
.rr-list { font-size: 13px; }
.rr-line { display: flex; flex-wrap: wrap; gap: 2px 10px; align-items: baseline; padding: 2px 0;
  overflow-wrap: anywhere; }
.rr-line > span { min-width: 0; }
.rr-line time { color: var(--rr-dim); font-size: 12px; flex: none; }
.rr-line.rr-red, .rr-line .rr-red { color: var(--rr-bad); } .rr-line.rr-yellow { color: var(--rr-amber); }
.rr-line.rr-bold { font-weight: 650; } .rr-line.rr-dim { color: var(--rr-dim); }
.rr-log { background: #111923; color: #e6ebf0; border-radius: 8px; padding: 10px 12px; margin: 0; max-height: 22em;
  overflow: auto; white-space: pre-wrap; overflow-wrap: anywhere; }
.rr-log .rr-red { color: #ffb0a8; } .rr-log .rr-yellow { color: #f5cf8a; } .rr-log .rr-dim { color: #9fabb8; }
.rr-events-box { margin-top: 8px; display: flex; flex-direction: column-reverse; max-height: 17em; overflow-y: auto; }
.rr-events { font: 12px/1.5 ui-monospace, "DejaVu Sans Mono", monospace; white-space: pre-wrap;
  overflow-wrap: anywhere;
  width: 100%; }
.rr-rows { width: 100%; } .rr-rows > .q-btn { max-width: 100%; text-align: left; }
.rr-rows > .q-btn .q-btn__content { text-align: left; justify-content: flex-start; }
.rr-row-bad .ag-cell { color: var(--rr-bad); } .rr-row-warm .ag-cell { color: var(--rr-amber); }
.ag-root-wrapper { --ag-background-color: var(--rr-paper); --ag-foreground-color: var(--rr-text);
  --ag-border-color: var(--rr-edge); --ag-header-background-color: var(--rr-raised); --ag-font-family: var(--rr-font);
  --ag-cell-font-family: var(--rr-font); --ag-header-font-family: var(--rr-font);
  --ag-font-size: 13px; --ag-header-text-color: var(--rr-dim); --ag-wrapper-border-radius: 10px; }
.rr-pictures img { max-width: 100%; border-radius: 6px; }
.rr-figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 380px), 1fr)); gap: 10px 22px; }
.rr-figures section { min-width: 0; } .rr-figures h2 { font-size: 13px; font-weight: 650; line-height: 1.6; margin: 0;
  overflow-wrap: anywhere; }
.rr-figures div { display: grid; grid-template-columns: 5.5em 1fr 5.5em; gap: 8px; align-items: center;
  font-size: 12px; color: var(--rr-fact); }
.rr-figures b { text-align: right; color: var(--rr-text); }
.rr-figures svg { width: 100%; height: 26px; background: var(--rr-unknown-paper); margin: 1px 0; border-radius: 3px; }
.rr-figures path { fill: none; stroke: var(--rr-focus); stroke-width: 1.5; vector-effect: non-scaling-stroke; }
.rr-loads { width: 100%; border-collapse: collapse; font-size: 13px; }
.rr-loads caption { text-align: left; font-weight: 650; padding: 2px 0 8px; }
.rr-loads th { color: var(--rr-dim); font-weight: 500; }
.rr-loads th button { background: none; border: none; padding: 0; font: inherit; color: inherit; cursor: pointer; }
.rr-loads th button:hover, .rr-loads th[aria-sort] button { color: var(--rr-text); }
.rr-loads th[aria-sort] button::after { content: " ↓"; }
.rr-loads th, .rr-loads td { text-align: right; padding: 5px 10px; height: 32px;
  border-bottom: 1px solid var(--rr-edge); }
.rr-loads tr:last-child td { border-bottom: none; }
.rr-loads th:first-child, .rr-loads td:first-child, .rr-loads .rr-left { text-align: left; overflow-wrap: anywhere; }
@media (max-width: 900px) { .rr-loads, .rr-loads :is(tbody, tr, td, caption) { display: block; }
  .rr-loads thead { display: none; } .rr-loads td, .rr-loads td:first-child { border: none; padding: 1px 4px;
  height: auto;
  text-align: left; } .rr-loads td::before { content: attr(data-head) ": "; color: var(--rr-dim); }
  .rr-loads tr { border-bottom: 1px solid var(--rr-edge); padding: 4px 0; } }
.rr-banner { width: 100%; padding: 8px 20px; background: var(--rr-warm-paper); color: var(--rr-text);
  font-weight: 600; }
.rr-banner.rr-bad { background: var(--rr-bad-paper); }
.rr-stale .rr-page > :not(.rr-past) { filter: grayscale(1); }
.rr-head { display: flex; gap: 16px; align-items: center; } .rr-head > div { flex: 1; min-width: 0; }
.rr-head p { margin: 0; color: var(--rr-dim); } .rr-head.rr-is-bad { background: var(--rr-bad-paper);
  border-color: var(--rr-bad-edge); } .rr-head.rr-is-warm { background: var(--rr-warm-paper); }
.rr-head.rr-is-bad p, .rr-head.rr-is-warm p { color: var(--rr-text); }
.rr-head > .rr-sign { font-size: 14px; }
.rr-five { display: grid; grid-template-columns: repeat(auto-fit, minmax(118px, 1fr)); gap: 12px; }
.rr-five .rr-card { padding: 12px 14px; } .rr-five h2 { font-size: 12.5px; font-weight: 500; color: var(--rr-dim);
  line-height: 1.4; margin: 0; } .rr-five b { font-size: 21px; font-weight: 650;
  margin-right: 6px; } .rr-five .rr-note { display: inline-block; }
.rr-five svg { display: block; width: 100%; height: 28px; margin-top: 6px; }
.rr-five path { fill: none; stroke: var(--rr-focus); stroke-width: 1.5; vector-effect: non-scaling-stroke; }
.rr-five .rr-is-bad path { stroke: var(--rr-bad); } .rr-five .rr-is-good path { stroke: var(--rr-good); }
.rr-overview { display: flex; flex-direction: column; gap: 16px; width: 100%; }
.rr-overview .rr-card > header { display: flex; justify-content: space-between; align-items: baseline; gap: 12px;
  flex-wrap: wrap; padding: 10px 16px; border-bottom: 1px solid var(--rr-edge); }
.rr-plain.rr-card { padding: 0; }
.rr-overview header h2 { font-size: 15px; font-weight: 650; line-height: 1.4; margin: 0; }
.rr-trouble { display: flex; gap: 12px; align-items: baseline; padding: 10px 16px;
  border-top: 1px solid var(--rr-edge); }
.rr-trouble:first-of-type { border-top: none; }
.rr-trouble > div { flex: 1; min-width: 0; overflow-wrap: anywhere; } .rr-trouble b { font-weight: 650;
  font-size: 14.5px; }
.rr-trouble p { margin: 0; color: var(--rr-dim); font-size: 13px; } .rr-trouble time { color: var(--rr-dim);
  font-size: 12.5px; white-space: nowrap; }
@media (max-width: 600px) { .rr-trouble { flex-wrap: wrap; } .rr-trouble > div { flex-basis: calc(100% - 28px); } }
.rr-empty { padding: 14px 16px; color: var(--rr-dim); margin: 0; }
.rr-lanes { padding: 8px 16px 12px; display: grid; grid-template-columns: minmax(80px, 160px) minmax(0, 1fr) auto;
  gap: 0 14px; align-items: center; }
.rr-lanes > a, .rr-lanes > span { font-size: 13px; line-height: 30px; min-height: 30px; overflow: hidden;
  text-overflow: ellipsis;
  white-space: nowrap; } .rr-lanes > a { color: inherit; text-decoration: none; }
  .rr-lanes > a:hover { color: var(--rr-focus); }
.rr-lanes svg { width: 100%; height: 18px; display: block; border-radius: 3px; }
.rr-lanes .rr-bar-good { fill: var(--rr-good-bar); } .rr-lanes .rr-bar-bad { fill: var(--rr-bad-bar); }
.rr-lanes .rr-bar-warm { fill: var(--rr-warm-bar); } .rr-lanes .rr-mark { stroke: var(--rr-bad); stroke-width: 2;
  vector-effect: non-scaling-stroke; }
dialog.rr-dialog { width: min(560px, calc(100vw - 24px)); border: 1px solid var(--rr-edge); border-radius: 10px;
  padding: 0;
  background: var(--rr-paper); color: var(--rr-text); margin: 12vh auto auto; }
  dialog.rr-dialog::backdrop { background: #0006; }
.rr-dialog input { width: 100%; padding: 12px 16px; border: none; border-bottom: 1px solid var(--rr-edge);
  outline: none;
  background: none; color: inherit; font: inherit; font-size: 15px; }
.rr-dialog ul { list-style: none; margin: 0; padding: 6px; max-height: 50vh; overflow: auto; }
.rr-dialog li { padding: 6px 10px; border-radius: 6px; display: flex; justify-content: space-between; gap: 12px;
  cursor: pointer;
  overflow-wrap: anywhere; } .rr-dialog li[aria-selected=true] { background: var(--rr-raised); }
.rr-dialog h2 { font-size: 15px; font-weight: 650; line-height: 1.4; margin: 0; padding: 12px 16px 0; }
.rr-dialog dl { display: grid; grid-template-columns: 90px 1fr; gap: 6px 12px; margin: 0; padding: 12px 16px 16px; }
.rr-dialog dd { margin: 0; } kbd { font: 12px ui-monospace, monospace; border: 1px solid var(--rr-outline);
  border-radius: 4px;
  padding: 0 5px; }
.rr-bar { width: 100%; background: var(--rr-nav); color: #fff; padding: 10px 20px; align-items: center; gap: 18px; }
.rr-bar a { color: var(--rr-nav-text); text-decoration: none; } .rr-bar a.rr-here { color: #fff; font-weight: 650; }
.rr-bar .rr-status { margin-left: auto; }
"""
CSS = _COLOURS + _FRAME + _PARTS

_SIGNS = {"bad": "◆", "warm": "▲", "good": "●", "still": "■"}
_OF = {
    **dict.fromkeys(("ERROR", "FATAL", "revoked", "unavailable", "unload_failed"), "bad"),
    **dict.fromkeys(("WARNING", "starting", "restarting", "reloading", "loading", "queued", "pausing"), "warm"),
    **dict.fromkeys(("OK", "running", "up", "loaded"), "good"),
}


def look_of(state: str) -> str:
    """Return how bad a state of a child or a resource is: "bad", "warm", "good", or "still"."""
    return _OF.get(state, "still")


def sign(look: str) -> str:
    """Return the sign of a look as HTML: its shape says what its colour says."""
    return f'<span class="rr-sign" aria-hidden="true">{_SIGNS[look]}</span>'


def pill(state: str) -> str:
    """Return a state as HTML: its colour, its shape, and its word."""
    look = look_of(state)
    return f'<span class="rr-pill rr-is-{look}">{sign(look)}{escape(state)}</span>'

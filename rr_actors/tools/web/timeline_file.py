"""A timeline as one HTML file, which a browser shows without a server and without the network."""

from __future__ import annotations

import json
from pathlib import Path

from rr_actors.base.notebook import escape
from rr_actors.system.recording import timelines
from rr_actors.system.recording.timelines import Timeline, looks

SCRIPT = Path(__file__).with_name("timeline_picture.js")

CSS = (
    timelines.CSS
    + """\
.rr-tl-host { color: var(--tl-text); font: 13px system-ui, sans-serif; min-width: 0; }
.rr-tl-bar { display: flex; flex-wrap: wrap; gap: 6px; align-items: center; padding: 4px 8px; }
.rr-tl-subject { flex: 1 1 12rem; overflow-wrap: anywhere; }
.rr-tl-bar button { min-width: 30px; padding: 3px 9px; border: 1px solid var(--tl-calm); border-radius: 5px;
  background: var(--tl-back); color: var(--tl-text); font: inherit; cursor: pointer; }
.rr-tl-bar button:hover { background: var(--tl-line); }
.rr-tl-plot { overflow: hidden auto; max-height: 62vh; cursor: grab; touch-action: pan-y; user-select: none; }
.rr-tl-plot:active { cursor: grabbing; } .rr-tl-plot svg { display: block; }
.rr-tl-plot:focus-visible, .rr-tl-bar button:focus-visible { outline: 3px solid var(--tl-fact); outline-offset: -2px; }
.rr-tl-axis { position: sticky; top: 0; z-index: 1; }
.rr-tl-mark { cursor: pointer; } .rr-tl .touch { fill: transparent; }
.rr-tl .ring { fill: none; stroke: var(--tl-text); stroke-width: 2; }
.rr-tl-legend { display: flex; flex-wrap: wrap; gap: 4px 14px; padding: 6px 8px; font-size: 12px; }
.rr-tl-legend span { display: inline-flex; gap: 4px; align-items: center; }
.rr-tl-why { margin: 4px 8px; padding: 6px 10px; min-height: 4.5em; max-height: 24vh; overflow: auto; font-size: 12px;
  border: 1px solid var(--tl-line); border-radius: 6px; white-space: pre-wrap; overflow-wrap: anywhere; }
"""
)


def html(timeline: Timeline) -> str:
    """Return an HTML document with the timeline, which can be zoomed and moved there."""
    data, names = (_in_script(thing) for thing in (timeline.plain(), looks()))
    script = SCRIPT.read_text()
    policy = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'"
    return f"""\
<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(timeline.subject)}</title>
<meta http-equiv="content-security-policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>{CSS}body {{ margin: 0; }} .rr-tl-plot {{ max-height: 75vh; }}</style></head>
<body class="rr-tl"><div class="rr-tl rr-tl-host"></div><script type="module">
{script}
new TimelineView(document.querySelector(".rr-tl-host"), {names}).show({data});
</script></body></html>
"""


def _in_script(thing: object) -> str:
    return json.dumps(thing, ensure_ascii=True).replace("<", "\\u003c")

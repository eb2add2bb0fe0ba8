"""Pictures for notebooks and files: well-formed, escaped, bounded, and drawn without a browser."""

from __future__ import annotations

import time
from xml.etree import ElementTree

from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.base.notebook import bundle_or_text, table
from rr_actors.base.svg_pictures import Box, draw
from support import serve

SVG = "{http://www.w3.org/2000/svg}"


def texts(svg: str) -> list[str]:
    return [element.text or "" for element in ElementTree.fromstring(svg).iter(f"{SVG}text")]


def rects(svg: str) -> list[tuple[float, float, float, float]]:
    found = list(ElementTree.fromstring(svg).iter(f"{SVG}rect"))[1:]  # the first is the ground
    return [(*(float(rect.attrib[name]) for name in ("x", "y", "width", "height")),) for rect in found]  # type: ignore[misc]


def test_a_tree_is_drawn_with_each_child_its_state_and_a_line_to_its_supervisor(system: rr.System) -> None:
    children = [rr.ChildSpec(rr.Actor, id=f"a{number}", placement="thread") for number in range(3)]
    inner = rr.Supervisor(children, id="inner")
    system.start_child(inner)
    svg = system.tree().svg()

    assert {"root", "inner", "a0", "a1", "a2"} <= set(texts(svg))
    assert any("running" in text for text in texts(svg))
    assert len(list(ElementTree.fromstring(svg).iter(f"{SVG}path"))) == 4
    assert rr.render(system.tree(), "svg") == svg


def test_boxes_do_not_overlap_and_lie_within_the_picture() -> None:
    boxes = {str(number): Box([f"node {number}", "more"]) for number in range(60)}
    svg = draw(boxes, [(str((number - 1) // 3), str(number)) for number in range(1, 60)])
    places = rects(svg)
    root = ElementTree.fromstring(svg)

    assert len(places) == 60
    assert all(x + w <= float(root.attrib["width"]) and y + h <= float(root.attrib["height"]) for x, y, w, h in places)
    for number, (x, y, w, h) in enumerate(places):
        for x2, y2, w2, h2 in places[number + 1 :]:
            assert x + w <= x2 or x2 + w2 <= x or y + h <= y2 or y2 + h2 <= y


@given(
    st.dictionaries(st.text(max_size=3), st.lists(st.text(max_size=20), max_size=3), max_size=8),
    st.lists(st.tuples(st.text(max_size=3), st.text(max_size=3)), max_size=12),
)
def test_any_graph_of_any_texts_is_well_formed_xml(lines: dict[str, list[str]], edges: list[tuple[str, str]]) -> None:
    svg = draw({name: Box(text) for name, text in lines.items()}, [*edges, *((name, name) for name in lines)])

    assert len(rects(svg)) == len(lines)


def test_some_hundred_boxes_are_drawn_quickly_and_more_are_counted() -> None:
    began = time.perf_counter()
    svg = draw({str(n): Box([f"node {n}"]) for n in range(800)}, [(str(n // 10), str(n)) for n in range(1, 800)])

    assert time.perf_counter() - began < 2
    assert len(rects(svg)) == 500
    assert texts(svg)[-1] == "300 more are left out"


def test_a_table_escapes_what_is_in_it_and_counts_what_is_not() -> None:
    found = table(("<b>", "n"), [("<script>alert(1)</script>", None)] * 201, "a & b")

    assert "<script>" not in found
    assert "&lt;script&gt;" in found
    assert "a &amp; b" in found
    assert "1 more are left out" in found
    ElementTree.fromstring(found)


def test_an_object_that_cannot_be_asked_is_shown_as_text() -> None:
    def fails() -> str:
        raise ValueError("gone")

    assert bundle_or_text("<It>", fails) == {"text/plain": "<It> (ValueError: gone)"}


def test_what_people_hold_is_shown_in_a_notebook(system: rr.System, app: rr.Registrar, provider: rr.Registrar) -> None:
    odd = "<img src=x onerror=alert(1)>"
    serve(provider, "thing")
    with system.record() as recording:
        query = app.load("provider/thing", odd)
    shown = {
        "query": query._repr_mimebundle_(),
        "provider": provider._repr_mimebundle_(),
        "app": app._repr_mimebundle_(),
        "trace": recording.trace(query)._repr_mimebundle_(),
        "history": system.supervisor().history()._repr_mimebundle_(),
    }
    tree = system.tree()._repr_mimebundle_()

    assert set(tree) == {"text/plain", "image/svg+xml", "text/vnd.mermaid"}
    assert all("text/html" in bundle for bundle in shown.values())
    assert all("<img" not in bundle["text/html"] for bundle in shown.values())
    assert "&lt;img" in shown["query"]["text/html"]
    assert "&lt;img" in shown["provider"]["text/html"]
    assert "serves 1" in shown["provider"]["text/html"]
    assert "holds 1" in shown["app"]["text/html"]
    assert shown["trace"]["text/vnd.mermaid"].startswith("sequenceDiagram")
    app.close()
    assert set(app._repr_mimebundle_()) == {"text/plain"}
    system.stop()
    assert "text/plain" in query._repr_mimebundle_()


def test_a_history_is_a_list_that_a_notebook_shows_as_a_table(system: rr.System) -> None:
    system.start_child(rr.ChildSpec(rr.Actor, id="actor", placement="thread"))
    history = system.supervisor().history()

    assert isinstance(history, list)
    assert "root/actor" in history._repr_mimebundle_()["text/html"]
    assert history[-1].event == "started"

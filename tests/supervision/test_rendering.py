"""A tree as text, as a Mermaid graph and in DOT: of a running system, and of a specification."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Mapping
from typing import Any

import pykka
import pytest

import rr_actors as rr
from rr_actors.supervision.supervisor import SupervisorRef
from support import eventually, hang

Start = Callable[..., rr.System]


class Cameras(rr.Manager):
    pass


class Worker(rr.Actor):
    def on_receive(self, message: Any) -> Any:
        return os.getpid()


SPEC = rr.Supervisor(
    [
        rr.ChildSpec(Cameras, id="cameras", restart="transient", significant=True),
        rr.Supervisor([rr.ChildSpec(Worker, id="job")], id="jobs", strategy="simple_one_for_one", placement="process"),
    ],
    strategy="rest_for_one",
    max_restarts=5,
    max_seconds=2.5,
    auto_shutdown="any",
)


def test_a_specification_is_shown_as_text() -> None:
    assert rr.render(SPEC).splitlines() == [
        "root        supervisor  rest_for_one, 5 in 2.5 s, auto_shutdown any",
        "├─ cameras  worker      Cameras                                      transient process  significant",
        "└─ jobs     supervisor  simple_one_for_one, 3 in 5 s                 permanent process",
        "   └─ job   worker      Worker, the template                         permanent process",
    ]


def test_a_running_tree_is_shown_with_states_processes_and_restarts(start: Start) -> None:
    inner = rr.Supervisor([rr.ChildSpec(Worker, id="w")], id="inner", strategy="one_for_all")
    system = start(rr.ChildSpec(Worker, id="a"), inner, rr.ChildSpec(Worker, id="b", placement="thread"))
    before = system.ref("a").ask("pid")
    os.kill(before, signal.SIGKILL)
    eventually(lambda: system.supervisor().which_children()[-1].pid not in (None, before))
    system.supervisor().terminate_child("b")

    lines = [re.sub(r"pid \d+", "pid N", line) for line in system.tree().render().splitlines()]

    assert [re.sub(" +", " ", line) for line in lines] == [
        "root supervisor one_for_one, 3 in 5 s",
        "├─ a worker running pid N 1 restart",
        "├─ inner supervisor one_for_all, 3 in 5 s running pid N",
        "│ └─ w worker running pid N",
        "└─ b worker stopped",
    ]
    assert f"pid {system.ref('a').ask('pid')} " in system.tree().render()
    assert str(system.tree("root/inner")).splitlines()[0].startswith("inner")
    assert system.tree().paths() == ["root", "root/a", "root/inner", "root/inner/w", "root/b"]
    assert rr.render(system.snapshot()["tree"]) == system.tree().render() == rr.render(system.tree())


def _described(data: Mapping[str, Any]) -> dict[str, Any]:
    """All but how long it has been up, which grows from one look to the next."""
    return {key: value for key, value in data.items() if key != "up_s"}


def test_a_child_that_is_no_supervisor_is_shown_as_its_supervisor_describes_it(start: Start) -> None:
    inner = rr.Supervisor([rr.ChildSpec(Worker, id="w")], id="inner")
    system = start(rr.ChildSpec(Worker, id="a"), inner, rr.ChildSpec(Cameras, id="cameras", placement="thread"))

    assert str(system.tree("a")) == f"a  worker  running  pid {system.ref('a').ask('pid')}"
    assert _described(system.tree("root/inner/w").data) == _described(system.tree("inner").data["children"][0])
    assert _described(system.tree("cameras").data) == _described(system.tree().data["children"][2])
    system.supervisor().terminate_child("a")
    system.supervisor().terminate_child("inner")
    assert str(system.tree("a")) == "a  worker  stopped"
    assert str(system.tree("inner")) == "inner  supervisor  stopped"


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("b", r"supervisor root has no child 'b' \(it has: a, inner\)"),
        ("root/inner/b", r"supervisor root/inner has no child 'b' \(it has: none\)"),
        ("a/b", "'root/a': it is no supervisor, but a child of class Worker"),
        ("b/c", "'root/b': .*there are: root, root/inner"),
    ],
)
def test_where_there_is_nothing_no_tree_is_shown(start: Start, path: str, text: str) -> None:
    system = start(rr.ChildSpec(Worker, id="a", placement="thread"), rr.Supervisor(id="inner"))

    with pytest.raises(rr.NotFound, match=text):
        system.tree(path)


def test_a_tree_is_a_mermaid_graph() -> None:
    assert rr.render(SPEC, "mermaid").splitlines() == [
        "graph TD",
        '    n0(["root<br/>rest_for_one, 5 in 2.5 s, auto_shutdown any"])',
        '    n1["cameras<br/>Cameras<br/>transient process<br/>significant"]',
        '    n2(["jobs<br/>simple_one_for_one, 3 in 5 s<br/>permanent process"])',
        '    n3["job<br/>Worker, the template<br/>permanent process"]',
        "    n0 --> n1",
        "    n0 --> n2",
        "    n2 --> n3",
    ]


def test_a_tree_is_a_graph_in_dot() -> None:
    lines = rr.render(SPEC, "dot").splitlines()

    assert lines[:3] == [
        'digraph "root" {',
        "    node [shape=box]",
        '    "root" [label="root\\nrest_for_one, 5 in 2.5 s, auto_shutdown any", shape=ellipse]',
    ]
    assert lines[-4:] == [
        '    "root" -> "root/cameras"',
        '    "root" -> "root/jobs"',
        '    "root/jobs" -> "root/jobs/job"',
        "}",
    ]


def test_what_does_not_run_stands_out_in_graphs(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, id="a"))
    system.supervisor().terminate_child("a")

    assert '["a<br/>stopped"]:::stopped' in system.tree().mermaid()
    assert "classDef stopped fill:" in system.tree().mermaid()
    assert 'label="a\\nstopped", style=filled' in system.tree().dot()


def test_a_supervisor_that_cannot_be_asked_is_shown_as_such() -> None:
    data = {"id": "root", "path": "root", "type": "supervisor", "error": "is being respawned", "children": []}

    assert rr.render(data) == "root  supervisor  unavailable"


def test_a_supervisor_whose_process_does_not_answer_is_shown_as_such(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs_spec = rr.Supervisor([rr.ChildSpec(Worker, id="w")], id="jobs", placement="process")
    system = start(rr.ChildSpec(Worker, id="a"), jobs_spec)
    pid = system.supervisor().which_child("jobs").pid
    assert pid is not None
    monkeypatch.setattr(SupervisorRef.__init__, "__kwdefaults__", {"timeout_s": 0.3})
    hang(pid)
    try:
        _, jobs = system.snapshot()["tree"]["children"]
        assert "no reply after 0.3 seconds" in jobs["error"]
        assert jobs["children"] == []
        assert "unavailable" in system.tree().render()
        assert "unavailable" in system.tree("jobs").render()
        states = {figure.labels["state"]: figure.value for figure in system.figures() if figure.name == "rr_children"}
        assert states["unavailable"] == 1
        with pytest.raises(pykka.Timeout):
            system.ref("w")
    finally:
        os.kill(pid, signal.SIGCONT)


def test_texts_are_escaped() -> None:
    data = {"id": 'a "b" <c>\\', "path": 'a "b"', "type": "worker"}

    assert '"a #quot;b#quot; &lt;c&gt;\\"' in rr.render(data, "mermaid")
    assert '"a \\"b\\"" [label="a \\"b\\" <c>\\\\"]' in rr.render(data, "dot")


@pytest.mark.parametrize("what", ["root", {}, None])
def test_what_is_no_tree_cannot_be_shown(what: Any) -> None:
    with pytest.raises(rr.UsageError, match="expected a Supervisor"):
        rr.render(what)


def test_an_unknown_format_is_named() -> None:
    with pytest.raises(rr.UsageError, match="expected 'text', 'mermaid', 'dot' or 'svg', got 'png'"):
        rr.render(SPEC, "png")  # type: ignore[arg-type]

"""What nodes write to a bridge, as JSON: read, or refused with what was expected and what was got."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.managers.ros.ros_messages import Load, Renew, Unload, answer_text, key_in, parsed

LOAD = {"id": "1", "owner": "/nav", "server": "cameras/camera"}


def test_a_message_is_read_and_has_its_defaults() -> None:
    assert parsed("/rr/load", json.dumps(LOAD), Load) == Load("1", "/nav", "cameras/camera", {}, None, 0)
    assert parsed("/rr/unload", '{"id": "1", "owner": "nav"}', Unload) == Unload("1", "/nav")
    assert parsed("/rr/renew", '{"id": "1", "owner": "/a/nav"}', Renew) == Renew("1", "/a/nav")


@pytest.mark.parametrize(
    ("text", "path", "expected", "got"),
    [
        ("", "", "a JSON object", "''"),
        ("{", "", "a JSON object", "'{'"),
        ("[1]", "", "object", "[1]"),
        ('"load"', "", "object", "'load'"),
        ("{}", "", "the fields id, owner, server", "{}"),
        (json.dumps({**LOAD, "id": ""}), "id", "str of length >= 1", "''"),
        (json.dumps({**LOAD, "id": 7}), "id", "str", "7"),
        (json.dumps({**LOAD, "owner": "x" * 201}), "owner", "str of length <= 200", "'xxx"),
        (json.dumps({**LOAD, "lease_s": 0}), "lease_s", "float > 0", "0"),
        (json.dumps({**LOAD, "lease_s": "5"}), "lease_s", "float | null", "'5'"),
        (json.dumps({**LOAD, "priority": 1001}), "priority", "int <= 1000", "1001"),
        (json.dumps({**LOAD, "lese_s": 5}), "", "object contains unknown field lese_s", "lese_s"),
    ],
)
def test_a_message_that_is_wrong_is_refused(text: str, path: str, expected: str, got: str) -> None:
    with pytest.raises(rr.InvalidRequest) as caught:
        parsed("/rr/load", text, Load)
    error: Any = caught.value
    assert (error.server, error.path) == ("/rr/load", path)
    assert expected in error.expected
    assert got in error.got
    assert str(error).startswith("/rr/load: ")


anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(st.text() | anything.map(json.dumps) | st.dictionaries(st.sampled_from([*LOAD, "x"]), anything).map(json.dumps))
def test_any_text_is_read_or_refused_and_its_answer_is_json(text: str) -> None:
    for kind in (Load, Unload, Renew):
        try:
            asked = parsed("/rr/load", text, kind)
        except rr.InvalidRequest as error:
            answer = json.loads(answer_text("load", key_in(text), error))
            assert answer["ok"] is False
            assert answer["error"]["type"] == "InvalidRequest"
            assert answer["error"]["details"]["expected"]
        else:
            assert asked.owner.startswith("/")


@given(anything)
def test_any_response_of_json_is_answered_as_it_is(response: Any) -> None:
    answer = json.loads(answer_text("load", ("/nav", "1"), None, "q", response))
    assert answer == {"for": "load", "id": "1", "owner": "/nav", "ok": True, "query": "q", "response": response}


def test_an_error_is_answered_with_its_trace() -> None:
    error = rr.LoadFailed("no device", server="cameras/camera", trace=(rr.Frame("cameras/camera", "OSError: gone"),))
    answer = msgspec.json.decode(answer_text("load", ("/nav", "1"), error))
    assert answer["error"] == {
        "type": "LoadFailed",
        "message": "no device",
        "trace": [{"origin": "cameras/camera", "message": "OSError: gone"}],
        "details": {"server": "cameras/camera"},
    }

"""The streams that a response names."""

from __future__ import annotations

import pytest

import rr_actors as rr
from rr_actors.base.names import new_id
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.streams.stream import streams_in


@pytest.mark.parametrize("epoch", [1, 2, 30])
def test_a_stream_of_a_provider_is_recognised_in_each_of_its_incarnations(epoch: int) -> None:
    stream = rr.Stream(Catalog("cameras", epoch=epoch).new_resource_id(new_id()), "images")

    assert [found for _, found in streams_in(encode({"left": stream}))] == [stream]


def test_a_class_of_the_user_with_the_same_fields_is_no_stream() -> None:
    assert streams_in(encode({"part": {"resource_id": "arm-7", "name": "left"}})) == []

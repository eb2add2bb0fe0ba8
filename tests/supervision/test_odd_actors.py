"""Classes that Python programmers write as actors: each works, or is refused by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import attrs
import pytest

import rr_actors as rr

T = TypeVar("T")


class Keeper(rr.Actor, Generic[T]):
    def __init__(self, value: T) -> None:
        self.value = value


@dataclass(frozen=True)
class Frozen(rr.Actor):
    value: int


@dataclass(frozen=True)
class FrozenManager(rr.Manager):
    value: int


@attrs.frozen
class FrozenByAttrs(rr.Actor):
    value: int


@dataclass
class Plain(rr.Actor):
    value: int


class Friend(rr.Actor):
    """Holds a proxy of another one in a public attribute."""

    friend: Any = None

    def meet(self, friend: Any) -> None:
        self.friend = friend

    def name(self) -> str:
        return "a friend"


@pytest.mark.parametrize("placement", ["thread", "process"])
@pytest.mark.parametrize("cls", [Frozen, FrozenManager, FrozenByAttrs])
def test_a_frozen_dataclass_is_refused_by_name(start: Callable[..., rr.System], cls: Any, placement: Any) -> None:
    with pytest.raises(rr.InvalidSpec, match=rf"without frozen=True.*{cls.__name__}'"):
        start(rr.ChildSpec(cls, id="one", args=(1,), placement=placement))


def test_a_frozen_dataclass_cannot_be_started_alone() -> None:
    with pytest.raises(rr.UsageError, match=r"Frozen.*frozen"):
        Frozen.start(1)


@pytest.mark.parametrize("placement", ["thread", "process"])
def test_a_plain_dataclass_is_an_actor(start: Callable[..., rr.System], placement: Any) -> None:
    system = start(rr.ChildSpec(Plain, id="one", args=(1,), placement=placement))
    assert system.ref("one").proxy().value.get(timeout=5) == 1


@pytest.mark.parametrize("placement", ["thread", "process"])
def test_a_generic_class_with_its_arguments_is_a_child(start: Callable[..., rr.System], placement: Any) -> None:
    spec = rr.ChildSpec(Keeper[int], args=(5,), placement=placement)  # type: ignore[type-abstract,arg-type]
    assert (spec.id, spec.actor_class_or_manager) == ("Keeper", Keeper)
    assert start(spec).ref("Keeper").proxy().value.get(timeout=5) == 5


def test_two_actors_may_hold_proxies_of_each_other() -> None:
    one, two = Friend.start(), Friend.start()
    one.proxy().meet(two.proxy()).get(timeout=5)
    two.proxy().meet(one.proxy()).get(timeout=5)
    assert one.proxy().friend.get(timeout=5).friend.get(timeout=5).name().get(timeout=5) == "a friend"
    assert two.proxy().name().get(timeout=5) == "a friend"
    for ref in (one, two):
        ref.stop()


@pytest.mark.parametrize("placement", ["thread", "process"])
def test_two_children_may_hold_proxies_of_each_other(start: Callable[..., rr.System], placement: Any) -> None:
    system = start(*(rr.ChildSpec(Friend, id=id, placement=placement) for id in ("one", "two")))
    one, two = system.ref("one"), system.ref("two")
    one.proxy().meet(two.proxy()).get(timeout=5)
    two.proxy().meet(one.proxy()).get(timeout=5)
    assert one.proxy().friend.get(timeout=5).friend.get(timeout=5).name().get(timeout=5) == "a friend"
    assert one.proxy().friend.get(timeout=5).name().get(timeout=5) == "a friend"

"""Indexes: ids by a key. Most keys have one id; a million of those must be no burden.

One id is a tuple: 48 bytes where a dict has 232, and nothing the garbage collector looks at twice.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable
from typing import TypeVar

K = TypeVar("K")
_SOME = 2000

Ids = tuple[str] | dict[str, None]
"""One id, or more, in the order in which they were added."""


def add(index: dict[K, Ids], key: K, id: str) -> None:
    """Put the id under the key."""
    ids = index.get(key)
    if ids is None:
        index[key] = (id,)
    elif type(ids) is dict:
        ids[id] = None
    elif id not in ids:
        index[key] = {**dict.fromkeys(ids), id: None}


def discard(index: dict[K, Ids], key: K, id: str) -> None:
    """Take the id away, and the key with the last of them."""
    ids = index.get(key)
    if ids is None or id not in ids:
        return
    if type(ids) is not dict:
        del index[key]
        return
    del ids[id]
    if len(ids) == 1:
        index[key] = (next(iter(ids)),)


def built(keys: Iterable[K], ids: Collection[str]) -> dict[K, Ids]:
    """The index that adding all of them comes to; keys and ids go in pairs. Of ids in a dict no hash is made again."""
    keys = list(keys)
    if len(ids) > 1 and keys[0] == keys[-1] and keys.count(keys[0]) == len(keys):
        return {keys[0]: dict.fromkeys(ids)}
    if len(set(keys[:_SOME])) == len(keys[:_SOME]):  # each has its own, perhaps
        index: dict[K, Ids] = dict(zip(keys, zip(ids, strict=True), strict=True))
        if len(index) == len(ids):
            return index
    groups: defaultdict[K, list[str]] = defaultdict(list)
    for key, id in zip(keys, ids, strict=True):
        groups[key].append(id)
    return {key: dict.fromkeys(group) if len(group) > 1 else (group[0],) for key, group in groups.items()}

"""One target under atheris, in its environment: `python -m fuzz.engine NAME DIRECTORY [libFuzzer's options]`.

libFuzzer keeps in DIRECTORY/corpus what reaches new code, changes it again, and stops at the first input that fails.
"""

from __future__ import annotations

import logging
import random
import sys
import tempfile
from pathlib import Path

import atheris
from atheris.import_hook import instrument_imports

with instrument_imports(include=["rr_actors", "tomllib"]):
    import tomllib  # noqa: F401  # here, or msgspec imports it later and nobody counts what it covers

    from fuzz.targets import TARGETS


def main() -> None:
    """Run until libFuzzer has had enough. It ends the process itself."""
    logging.disable(logging.CRITICAL)  # each refusal would be a line
    name, directory, *options = sys.argv[1:]
    target = TARGETS[name]
    place = Path(directory)
    seeds, corpus, words = place / "seeds", place / "corpus", place / "words"
    for folder in (seeds, corpus):
        folder.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(target.seeds()):
        (seeds / f"{number:03}").write_bytes(seed)
    words.write_text("".join(f'"{_escaped(word)}"\n' for word in target.words))
    options += [f"-max_len={target.longest}", f"-artifact_prefix={place}/failing-"]
    options += [f"-dict={words}"] if target.words else []  # an empty one is an error
    mutate = target.mutate

    def custom(data: bytes, longest: int, seed: int) -> bytes:
        chance = random.Random(seed)
        if mutate is not None and chance.random() < 0.7:
            for _ in range(chance.choice((1, 1, 2, 4))):
                data = mutate(data, chance)
            return data[:longest]
        return atheris.Mutate(data, longest)  # by that name: Setup puts another in its place

    feed = target.prepare(Path(tempfile.mkdtemp()))  # below what __main__ removes: this process does not end by itself
    own = {} if mutate is None else {"custom_mutator": custom}
    atheris.Setup([sys.argv[0], *options, str(corpus), str(seeds)], feed, **own)
    atheris.Fuzz()


def _escaped(word: bytes) -> str:
    return "".join(f"\\x{byte:02x}" for byte in word)


if __name__ == "__main__":
    main()

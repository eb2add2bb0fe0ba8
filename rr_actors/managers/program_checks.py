"""What is wrong with the programs of a registry, as far as its file alone says it. Pure."""

from __future__ import annotations

import signal
import string
from collections.abc import Iterable, Iterator

from rr_actors.base.checks import is_number
from rr_actors.base.errors import ConfigError, shown
from rr_actors.base.toml import wrong
from rr_actors.managers.programs import RunProgram
from rr_actors.managers.templates import Parameters

_TEMPLATE = "text in which ${name} or $$ follows each dollar sign"


def program_faults(file: str, key: str, program: RunProgram) -> Iterator[ConfigError]:
    """Yield what would be wrong at each load of a program that stands at `key` in a file."""
    if not program.command:
        yield wrong(file, f"{key}.command", "the name of a program", program.command)
    if program.stop_signal not in signal.Signals.__members__:
        said = f"{shown(program.stop_signal)}"
        yield wrong(
            file, f"{key}.stop_signal", "the name of a signal, such as 'SIGTERM'", program.stop_signal, said=said
        )
    for name, amount in program.cost.items():
        if not is_number(amount) or amount < 0:
            yield wrong(file, f"{key}.cost.{name}", "a number of at least 0", amount)
    texts = [("command", program.command), ("directory", program.directory or "")]
    texts += [(f"arguments[{i}]", text) for i, text in enumerate(program.arguments)]
    texts += [(f"environment.{name}", text) for name, text in program.environment.items()]
    yield from template_faults(file, key, texts)


def parameter_faults(file: str, key: str, parameters: Parameters) -> Iterator[ConfigError]:
    """Yield which parameters that stand at `key` in a file are no templates."""
    yield from template_faults(file, key, ((name, str(value)) for name, value in parameters.items()))


def template_faults(file: str, key: str, texts: Iterable[tuple[str, str]]) -> Iterator[ConfigError]:
    """Yield which texts, by their keys below `key`, have a dollar sign that begins nothing."""
    for name, text in texts:
        if not string.Template(text).is_valid():
            yield wrong(file, f"{key}.{name}", _TEMPLATE, text)

"""experiment(): what settings of a tree change about its availability, over many simulated runs."""

from __future__ import annotations

import dataclasses
import itertools
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast

from rr_actors.base.checks import invalid
from rr_actors.base.errors import InvalidSpec, is_a, shown
from rr_actors.base.names import child_meant, no_child
from rr_actors.base.notebook import bundle, table
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.system.simulated.bar_charts import Bar, bar_chart
from rr_actors.system.simulated.simulated_runs import Scenario, SimulatedRun, paths_of, simulate

_MEASURES = ("availability", "worst_availability", "longest_outage_s", "restarts", "ended", "ended_after_s")


class TreeExperiment:
    """The result of an experiment: a row for each combination of settings. str() is a table; a notebook adds a plot.

    Attributes:
        rows: plain data, as `pandas.DataFrame(rows)` takes it. Each has the settings, and over all runs:
            "availability", the mean over all children that are no supervisors, from 0 to 1;
            "worst_availability", the mean of the worst child of each run;
            "longest_outage_s", the mean of the longest outage of any child;
            "restarts", the mean of all restarts of one run;
            "ended", the part of the runs in which the tree ended, from 0 to 1;
            "ended_after_s", the median of the time to that end, or None.
        runs: how many runs each row has.
    """

    def __init__(self, rows: list[dict[str, Any]], settings: Sequence[str], runs: int) -> None:
        self.rows = rows
        self.runs = runs
        self._settings = settings

    def svg(self) -> str:
        """Return an SVG document: a bar for each row, its mean availability, and the worst child's."""
        bars = [
            Bar(self._label(row), row["availability"], row["worst_availability"], f"{row['availability']:.2%}")
            for row in self.rows
        ]
        return bar_chart(bars, f"mean availability, and the worst child's (line), of {self.runs} runs each")

    def _label(self, row: Mapping[str, Any]) -> str:
        return ", ".join(f"{name} {_text(row[name])}" for name in self._settings)

    def _cells(self) -> Iterator[list[str]]:
        for row in self.rows:
            ended_s = row["ended_after_s"]
            yield [
                *(_text(row[name]) for name in self._settings),
                f"{row['availability']:.3%}",
                f"{row['worst_availability']:.3%}",
                f"{row['longest_outage_s']:.2f} s",
                f"{row['restarts']:.1f}",
                f"{row['ended']:.1%}",
                "" if ended_s is None else f"{ended_s:.0f} s",
            ]

    @property
    def _heads(self) -> list[str]:
        return [*self._settings, "available", "worst child", "longest outage", "restarts", "ended", "after"]

    def __str__(self) -> str:
        rows = [self._heads, *self._cells()]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return "\n".join(
            "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
        )

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return bundle(str(self), html=f"{table(self._heads, self._cells())}{self.svg()}")

    def __repr__(self) -> str:
        return f"<TreeExperiment of {len(self.rows)} settings, {self.runs} runs each>"


def experiment(
    tree: Supervisor,
    scenario: Scenario,
    *,
    vary: Mapping[str, Sequence[object]],
    runs: int = 100,
    until_s: float = 3600.0,
    seed: int = 1,
    start_s: float = 0.1,
) -> TreeExperiment:
    """Simulate a tree many times with each combination of settings, and compare what becomes of its children.

    Each combination meets the same deaths: run number n has the seed `seed` + n with all of them.

    Args:
        tree: the specification of the root.
        scenario: as simulate() takes it.
        vary: the values of each setting. "max_restarts" is the root's, "drive.max_restarts" is the setting of the
            child or supervisor with that path or id: `{"strategy": ["one_for_one", "rest_for_one"]}`.
        runs: how many runs for each combination. Default: 100. Take more for what seldom happens.
        until_s: how long each run is, in virtual seconds. Default: 3600.0, an hour.
        seed: of the first run. Default: 1.
        start_s: seconds that a child without a model needs for its start. Default: 0.1.

    Raises:
        InvalidSpec: `.field`, `.expected`, `.got`, for an unknown setting or a value that it cannot have.
        NotFound: the scenario or a setting names an unknown child.
    """
    if not is_a(runs, int) or runs < 1:
        raise invalid("experiment", "runs", "a whole number above 0", runs)
    if not isinstance(cast(object, tree), Supervisor):
        raise invalid("experiment", "tree", "a Supervisor", tree)
    names = _checked(vary)
    rows: list[dict[str, Any]] = []
    for values in itertools.product(*(vary[name] for name in names)):
        varied = tree
        for name, value in zip(names, values, strict=True):
            varied = _with(varied, name, value)
        found = [simulate(varied, scenario, until_s=until_s, seed=seed + n, start_s=start_s) for n in range(runs)]
        workers = [path for path, child in paths_of(varied).items() if child.type == "worker"]
        rows.append(dict(zip(names, values, strict=True)) | _measures(found, workers))
    return TreeExperiment(rows, names, runs)


def _checked(vary: object) -> list[str]:
    if not isinstance(vary, Mapping) or not vary:
        raise invalid("experiment", "vary", "a dict with a list of values for each setting", cast(object, vary))
    for name, values in cast("Mapping[object, object]", vary).items():
        if not isinstance(name, str):
            raise invalid("experiment", "vary", "names of settings", name)
        if name in _MEASURES:
            raise invalid("experiment", "vary", "names of settings", name)
        if not isinstance(values, list | tuple) or not values:
            raise invalid("experiment", f"vary[{name!r}]", "a list of values, at least one", cast(object, values))
    return list(cast("Mapping[str, object]", vary))


def _measures(runs: Sequence[SimulatedRun], workers: Sequence[str]) -> dict[str, Any]:
    ends = [run.ended_at for run in runs if run.ended_at is not None]
    of_run = [[run.children[path].availability for path in workers] for run in runs]
    return {
        "availability": statistics.fmean(itertools.chain.from_iterable(of_run)) if workers else 1.0,
        "worst_availability": statistics.fmean(min(each, default=1.0) for each in of_run),
        "longest_outage_s": statistics.fmean(
            max((run.children[path].longest_outage_s for path in workers), default=0.0) for run in runs
        ),
        "restarts": statistics.fmean(sum(run.children[path].restarts for path in workers) for run in runs),
        "ended": len(ends) / len(runs),
        "ended_after_s": statistics.median(ends) if ends else None,
    }


def _with(tree: Supervisor, name: str, value: object) -> Supervisor:
    """Return the tree with one setting of the root, or of the child that the name begins with, changed."""
    child, _, field = name.rpartition(".")
    path = child_meant(child, {tree.id, *paths_of(tree)}) if child else tree.id
    if path is None:
        raise no_child(child, paths_of(tree).keys())
    try:
        return cast("Supervisor", _changed(tree, path.split("/")[1:], field, value))
    except InvalidSpec as error:
        got = error.details.get("got", value)
        raise invalid("experiment", f"vary[{name!r}]", str(error.details.get("expected")), got) from error


def _changed(spec: Supervisor | ChildSpec, below: Sequence[str], field: str, value: object) -> Supervisor | ChildSpec:
    if not below:
        inner = spec.actor_class_or_manager if isinstance(spec, ChildSpec) else spec
        known = [each.name for each in dataclasses.fields(spec) if each.name not in _OF_THE_TREE]
        if isinstance(spec, ChildSpec) and isinstance(inner, Supervisor) and field not in known:
            return dataclasses.replace(spec, actor_class_or_manager=_changed(inner, below, field, value))
        if field not in known:
            raise InvalidSpec(f"no setting {shown(field)}", expected=f"one of {', '.join(known)}", got=field)
        return dataclasses.replace(spec, **{field: value})
    if isinstance(spec, ChildSpec):
        inner = _changed(cast("Supervisor", spec.actor_class_or_manager), below, field, value)
        return dataclasses.replace(spec, actor_class_or_manager=inner)
    children = [_changed(each, below[1:], field, value) if each.id == below[0] else each for each in spec.children]
    return dataclasses.replace(spec, children=children)


_OF_THE_TREE = ("children", "id", "actor_class_or_manager", "args", "kwargs", "renamed_from")
"""Fields of a specification that are no settings of it."""


def _text(value: object) -> str:
    return value if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)

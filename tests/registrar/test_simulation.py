"""The registrar's core in simulated worlds that break in every way, checked by what the outside has seen."""

from __future__ import annotations

from typing import Any

import pytest

from rr_actors.registrar.core.decide import decide
from rr_actors.registrar.model import digests
from rr_actors.registrar.model.catalog import Catalog
from simulation import Outcome, replay, report, run, shrink
from simulation.__main__ import main
from simulation.process_faults import (
    AT_ONCE_FIRST,
    BRIEF_FIRST,
    FIRST,
    HASTY_FIRST,
    IDLE_FIRST,
    LIVES_FIRST,
    OWE_FIRST,
    PARTS_FIRST,
    RANK_FIRST,
    RELOAD_FIRST,
    REVOKE_FIRST,
    SAY_FIRST,
    SWAP_FIRST,
    TELL_FIRST,
)
from simulation.quiescence import INDEXES, compared
from simulation.runner import kind_of
from simulation.sim_registrar import SimRegistrar
from support_directed import DIRECTED_WORLDS
from support_mutations import DIRECTED, MUTATIONS

WORLDS_FOR_A_MUTATION = 1500

# Every one of these once broke a promise; the commit that made it keep it says which.
SEEDS_THAT_FAILED = (
    *(15, 20, 32, 33, 43, 49, 93, 110, 121, 122, 130, 168, 174, 309, 317, 338, 366, 672, 793, 816, 1075, 1476, 1832),
    *(1910, 1911, 1970, 2793, 2862, 2977, 3097, 3409, 3573, 4018, 4440, 5023, 9677, 13383, 18596, 32198, 37990),
    *(704117, 704257, 912980, 612062800862, 562580627132, 562580627318, 70157317288, 642478355300, 765765286147),
    *(1099511629629, 2052689081474, 2007437875214, 1942383968653, 1156416575523, 1376241970582),
    *(
        1905475446746,
        1448093706074,
        5385071411748,
        7628463471197,
        7550649148702,
        5401442734826,
        6739136118399,
        4815942032500,
        5212514472870,
        8418496889417,
        6993024521295,
        6044783824402,
        4423351844953,
        42038849739183,
        56334241241641,
        123982906069672,
        234754673078627,
        282529395909312,
        528097064548645,
        234754673078943,
        384827090348427,
        282224888502020,
        428884282691262,
        291920137100204,
        317511325547352,
        334405804105827,
        506563340900025,
        341206556606190,
    ),
    *(562949953421449, 562949953422195, 562949953422290, 562949953422611, 562949953422987, 562949953423163),
    *(562949953423508, 562949953424676, 562949953426425, 591494579122003, 591494579121787),
    *(591494579111947, 591494579113873, 691494579101702, 691494579112308),
    *(700000000003440, 700000000008059, 710000000021883, 720000000013046, 720000000047468, 720000000049692),
    *(720000000076682, 720000000103535, 658211668766320, 282525437366615, 282188443193118),
    *(281796104698359, 1814140422246228, 2124356231658425, 3000000000000695),
    *(
        4603599627393736,
        4703599627428769,
        5203599627440150,
        5603599627375579,
        5803599627417252,
        7503599627373072,
        7603599627381737,
        4503599627373482,
    ),
)


def assert_kept(outcome: Outcome) -> None:
    if outcome.violation is not None:
        pytest.fail(report(outcome), pytrace=False)


FIRSTS = (
    *(
        RELOAD_FIRST,
        IDLE_FIRST,
        REVOKE_FIRST,
        RANK_FIRST,
        LIVES_FIRST,
        PARTS_FIRST,
        SWAP_FIRST,
        SAY_FIRST,
        HASTY_FIRST,
        TELL_FIRST,
    ),
    *(AT_ONCE_FIRST, OWE_FIRST, BRIEF_FIRST, 0, FIRST),
)


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("first", FIRSTS)
def test_fixed_seeds_keep_every_promise(first: int) -> None:
    for seed in range(first, first + 250):
        assert_kept(run(seed))


# And these in histories of so many steps.
LONG_SEEDS_THAT_FAILED = (
    *((2136415207651, 1500), (1384620891981, 1500), (1648130432810, 1500), (6398237322144, 2500)),
    (15194771783290, 2500),
    (12892751787730, 2500),
    (14000000021718, 2500),
    (14100000022093, 2500),
)


@pytest.mark.parametrize("seed", SEEDS_THAT_FAILED)
def test_a_seed_that_once_failed_keeps_every_promise(seed: int) -> None:
    assert_kept(run(seed))


@pytest.mark.parametrize(("seed", "steps"), LONG_SEEDS_THAT_FAILED)
def test_a_long_history_that_once_failed_keeps_every_promise(seed: int, steps: int) -> None:
    assert_kept(run(seed, steps))


def test_lists_that_are_compared_in_many_spans_keep_every_promise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(digests, "LENGTH", 2)
    for seed in (*range(100), *range(FIRST, FIRST + 100)):
        assert_kept(run(seed))


def test_a_long_history_keeps_every_promise() -> None:
    for seed in (0, 1, 2, FIRST, FIRST + 1, FIRST + 2):
        assert_kept(run(seed, steps=10_000))


def test_the_same_seed_is_the_same_history() -> None:
    for seed in (*range(20), *range(FIRST, FIRST + 20)):
        assert run(seed).history == run(seed).history


@pytest.mark.parametrize("name", DIRECTED_WORLDS)
def test_a_directed_world_keeps_every_promise(name: str) -> None:
    assert replay(*DIRECTED_WORLDS[name]) is None


@pytest.mark.parametrize("name", DIRECTED)
def test_a_broken_protocol_is_noticed_in_the_world_directed_at_it(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    mutation, broken = DIRECTED[name]
    seed, history = DIRECTED_WORLDS[name]
    assert kind_of(replay(seed, history, mutation(monkeypatch.setattr))) == broken


NOTICED_BY = {
    "priority not lowered when a holder leaves": 1125899906842812,
    "a priority acknowledged and lost in a crash": 1125899906842784,
    "lists compared by their ids alone": 4503599627370581,
    "a priority lost with its link": 2251799813685319,
    "what is needed left paused": 4503599627370573,
    "a part in flight overlooked": 2251799813685323,
    "lost without a word": 2251799813685327,
    "no link for acknowledgements": 36,
    "interrupted load not started clean": 281474976710689,
    "parts of a failed load kept": 8796093022239,
    "attempt stamp not checked in reconcile": 1125899906842644,
    "what is on standby never paused": 4503599627370512,
    "release written later": 14,
}
"""Of what few worlds notice, one that does. Where the worlds have changed since, all are searched again."""


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("name", MUTATIONS)
def test_a_broken_protocol_is_noticed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    factory = MUTATIONS[name](monkeypatch.setattr)
    if name in NOTICED_BY and run(NOTICED_BY[name], factory=factory).violation is not None:
        return
    for number in range(WORLDS_FOR_A_MUTATION):
        for first in FIRSTS:
            outcome = run(first + number, factory=factory)
            if outcome.violation is not None:
                return
    pytest.fail(f"{name}: not noticed in {len(FIRSTS) * WORLDS_FOR_A_MUTATION} worlds")


def test_a_violation_is_shrunk_to_a_short_history_and_told_as_a_timeline(monkeypatch: pytest.MonkeyPatch) -> None:
    factory = MUTATIONS["unload without waiting for the last holder"](monkeypatch.setattr)
    outcome = next(o for o in (run(seed, factory=factory) for seed in range(100)) if o.violation is not None)

    history = shrink(outcome, factory)
    text = report(outcome, factory)

    assert len(history) < len(outcome.history)
    assert kind_of(replay(outcome.seed, history, factory)) == kind_of(outcome.violation)
    assert f"seed {outcome.seed}" in text
    assert "Unload(" in text


# -- a decision that could not be committed has not happened ----------------------------------------------------------


def picture(catalog: Catalog) -> dict[str, Any]:
    """Everything a catalog knows, as it is now."""
    return {
        name: {key: dict(v) if isinstance(v, dict) else v for key, v in value.items()}
        if isinstance(value, dict)
        else value
        for name, value in {**vars(catalog), **{name: compared(getattr(catalog, name)) for name in INDEXES}}.items()
        if name != "_index"
    }


class Undoes(SimRegistrar):
    """Decides everything twice: once to take it back again."""

    def wake(self, count: int, fault: str, effects: int) -> None:
        before = picture(self.catalog)
        decision = decide(self.catalog, list(self.inbox)[:count])
        decision.undo()
        after = picture(self.catalog)
        assert after == before, [name for name in before if before[name] != after[name]]
        assert (decision.changes, decision.later, decision.effects) == ([], {}, [])
        super().wake(count, fault, effects)


def test_undo_restores_rows_indexes_and_memory_exactly() -> None:
    for seed in (*range(40), *range(FIRST, FIRST + 40)):
        assert_kept(run(seed, factory=Undoes))


# -- the tools -------------------------------------------------------------------------------------------------------


def test_the_command_runs_as_many_worlds_as_asked(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["20", "--seed", "5", "--steps", "100"]) == 0
    assert "20 worlds" in capsys.readouterr().out

"""The pages of the lab: one for the experiments, which asks, runs, plays again and compares; one with ten questions."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from urllib.parse import urlencode

from fastapi import Request
from fastapi.responses import PlainTextResponse, Response
from nicegui import app, ui

from rr_actors.base.errors import RrError
from rr_actors.system.console import console_commands as commands
from rr_actors.tools.web.lab.lab_declarations import LabExperiment
from rr_actors.tools.web.lab.lab_folder import Lab, programs_in, read_lab
from rr_actors.tools.web.lab.lab_notebook import notebook_of
from rr_actors.tools.web.lab.lab_player import Player
from rr_actors.tools.web.lab.lab_questions import QUESTIONS, Asked
from rr_actors.tools.web.lab.lab_runs import AT_ONCE, Place, Run
from rr_actors.tools.web.page_parts import CSS

_LOOK_S = 0.2
_CSS = (
    CSS
    + """\
.rr-lab { display: grid; grid-template-columns: 15rem minmax(0, 1fr); gap: 14px; width: 100%; padding: 8px 14px; }
@media (max-width: 900px) { .rr-lab { grid-template-columns: minmax(0, 1fr); } }
.rr-lab .q-btn__content { text-align: left; }
.rr-broken { white-space: pre-line; overflow-wrap: anywhere; }
.rr-verdict { width: 100%; padding: 6px 10px; border-left: 4px solid var(--rr-focus);
  background: var(--rr-unknown-paper); font-weight: 600; }
.rr-lab-tree { min-height: 320px; } .rr-h1 { font: 600 18px/1.5 sans-serif; } .rr-h2 { font: 600 15px/1.5 sans-serif; }
.rr-lab a, .rr-page a { color: var(--rr-focus); }
.rr-code { width: 100%; } .rr-code textarea { font: 12px/1.45 monospace; min-height: 24rem; white-space: pre; }
"""
)


def add_lab(folders: Sequence[Path], *, takes_code: bool) -> None:
    """Add the pages of the lab to NiceGUI's application.

    Args:
        folders: have the experiments; each page reads them anew.
        takes_code: the page's reader may change an experiment's code, and run that.

    Raises:
        UsageError: a folder is missing, or has no programs.
    """
    for folder in folders:
        programs_in(folder)
    runs: set[Run] = set()

    def stop_all() -> None:
        for one in list(runs):
            one.stop()

    @app.get("/lab/{name}.ipynb")
    def _(name: str, request: Request) -> Response:
        chosen = read_lab(folders).experiments.get(name)
        levers = chosen.values(request.query_params) if chosen is not None else None
        if chosen is None or levers is None:
            return PlainTextResponse(f"{name}: no such experiment, or no such value of a lever\n", 404)
        headers = {"Content-Disposition": f'attachment; filename="{name}.ipynb"'}
        return Response(notebook_of(chosen, levers), media_type="application/x-ipynb+json", headers=headers)

    @ui.page("/lab", title="rr-actors: lab")
    async def _(experiment: str = "") -> None:
        page = LabPage(lab := await asyncio.to_thread(read_lab, folders), runs, takes_code)
        if chosen := lab.experiments.get(experiment):
            await page.choose(chosen)

    @ui.page("/lab/questions", title="rr-actors: ten questions")
    async def _() -> None:
        QuestionsPage(await asyncio.to_thread(read_lab, folders))

    ui.page("/", title="rr-actors: lab")(lambda: ui.navigate.to("/lab"))
    app.on_shutdown(lambda: asyncio.to_thread(stop_all))


def _bar(here: str) -> ui.label:
    """Draw the bar of a page; return the label of its status."""
    ui.add_css(_CSS)
    with ui.row().classes("rr-bar"):
        ui.label("rr-actors lab").classes("text-bold")
        for name, target in (("Experiments", "/lab"), ("Ten questions", "/lab/questions")):
            ui.link(name, target).classes("rr-here" if target == here else "")
        return ui.label().classes("rr-status").props('role="status"')


def _heading(text: str, level: int) -> ui.label:
    return ui.label(text).classes(f"rr-h{level}").props(f'role="heading" aria-level="{level}"')


class LabPage:
    """The page with the experiments. A page runs one at a time, and ends it when it is closed.

    Args:
        lab: the experiments, and what is wrong with other files.
        runs: the runs of all pages.
        takes_code: the reader may change the code, and run that.
    """

    def __init__(self, lab: Lab, runs: set[Run], takes_code: bool) -> None:
        self._place = Place(runs)
        self._takes_code = takes_code
        self._experiment: LabExperiment | None = None
        self._chosen = ""  # the path of a child
        self._is_told = False  # what the run has shown
        self._status = _bar("/lab")
        self._status.text = "choose an experiment"
        with ui.element("main").classes("rr-lab"):
            with ui.element("nav").props('aria-label="experiments"').classes("column gap-2"):
                for one in lab.experiments.values():
                    self._button(one)
                for text in lab.broken:
                    ui.label(text).classes("rr-note rr-broken").props('role="alert"')
            with ui.column().classes("gap-2").style("min-width: 0"):
                self._build()
        ui.context.client.on_delete(self._place.leave)
        ui.timer(_LOOK_S, self._look)

    def _build(self) -> None:
        self._title = _heading("Experiments", 1)
        self._about = ui.label(
            "Each experiment is a real system of a few processes, for half a minute or so. Choose one, say what you "
            "expect, and run it."
        )
        self._setup = ui.column().classes("gap-2 w-full")
        with ui.row().classes("gap-2 items-center") as self._run_row:
            ui.button("run it", on_click=self._start).props("outline no-caps dense")
            ui.button("stop it", on_click=self._place.stop).props("outline no-caps dense")
            self._hint = ui.button("what to look for", on_click=self._show_hint).props("outline no-caps dense")
            self._notebook = ui.link("the same as a notebook", "/lab")
        self._look_for = ui.label("").classes("text-bold")
        self._verdict = ui.label("").classes("rr-verdict").props('role="alert"')
        self._why = ui.label("")
        self._hide_answers()
        self._player = Player(self._pick)
        with self._player.buttons:
            self._kill_button = ui.button("kill -9 the chosen child", on_click=self._kill)
            self._kill_button.props("outline no-caps dense").bind_enabled_from(self, "can_kill")
        with ui.element("section").classes("w-full") as self._code_part:
            _heading("Its code", 2)
            self._code_hint = ui.label().classes("rr-note")
            self._code = ui.textarea("program").classes("rr-code").props("outlined")
        for part in (self._run_row, self._code_part):
            part.set_visibility(False)

    @property
    def can_kill(self) -> bool:
        """Whether a child is chosen that a button can kill now."""
        run = self._place.run
        return "/" in self._chosen and run is not None and run.is_running and self._player.is_live

    def _button(self, experiment: LabExperiment) -> None:
        button = ui.button(experiment.button, on_click=partial(self.choose, experiment))
        button.props("outline no-caps align=left").classes("w-full")

    def _hide_answers(self) -> None:
        for part in (self._look_for, self._verdict, self._why):
            part.set_visibility(False)
        self._hint.set_visibility(True)

    def _show_hint(self) -> None:
        self._look_for.set_visibility(bool(self._look_for.text))
        self._hint.set_visibility(False)

    async def choose(self, experiment: LabExperiment) -> None:
        """Show an experiment that waits to be run."""
        await self._place.stop()
        self._player.show(None)
        self._experiment, self._chosen = experiment, ""
        self._title.text, self._about.text = experiment.title, experiment.about
        self._look_for.text = f"Look for: {experiment.look_for}" if experiment.look_for else ""
        self._why.text = f"Why: {experiment.why}" if experiment.why else ""
        self._hide_answers()
        if experiment.question is None:
            self._show_hint()
        self._original = self._code.value = experiment.code
        self._status.text = f"{experiment.name} waits for you"
        self._levers = {lever.name: str(lever.choices[0]) for lever in experiment.levers}
        self._answers: dict[str, bool] = dict.fromkeys(experiment.declared.answers, False)
        self._setup.clear()
        with self._setup:
            self._show_setup(experiment)
        self._code_hint.text = (
            "Change it, and run it: your text runs in the place of this one, as your own program would."
            if self._takes_code
            else "It can be changed where the lab listens at this machine alone."
        )
        self._code.set_enabled(self._takes_code)
        self._link()
        for part in (self._run_row, self._code_part):
            part.set_visibility(True)

    def _show_setup(self, experiment: LabExperiment) -> None:
        with ui.row().classes("gap-4"):
            for lever in experiment.levers:
                select = ui.select([str(choice) for choice in lever.choices], label=lever.label)
                select.props("dense outlined").style("min-width: 14.5rem")
                select.bind_value(self._levers, lever.name).on_value_change(self._link)
        if experiment.question is not None:
            _heading(experiment.question.text, 2)
            with ui.row().classes("gap-4"):
                for answer in self._answers:
                    ui.checkbox(answer).bind_value(self._answers, answer)

    def _link(self) -> None:
        assert self._experiment is not None
        self._notebook.props(f'href="/lab/{self._experiment.name}.ipynb?{urlencode(self._levers)}"')

    async def _start(self) -> None:
        experiment = self._experiment
        if experiment is None:
            return
        text = self._code.value or ""
        code = text if self._takes_code and text != self._original else ""
        for part in (self._verdict, self._why):
            part.set_visibility(False)
        self._asked = frozenset(answer for answer, is_given in self._answers.items() if is_given)
        if self._asked:
            self._show_hint()
        if not await self._place.start(experiment.program, experiment.values(self._levers), code):
            ui.notify(f"{AT_ONCE} experiments run already: stop one, or wait for its end", type="warning")
            return
        self._chosen, self._is_told = "", False
        self._player.show(self._place.run)

    def _pick(self, path: str) -> None:
        self._chosen = path
        self._player.choose(path)

    async def _kill(self) -> None:
        run = self._place.run
        if run is None or run.watch is None:
            return
        try:
            done = await asyncio.to_thread(run.watch.link.ask, commands.Kill(self._chosen))
        except RrError as error:
            ui.notify(f"kill -9: {error}", type="negative")
        else:
            ui.notify(done.text, type="positive")

    def _look(self) -> None:
        run = self._player.run
        if run is None:
            return
        self._status.text = f"{run.name} {'runs' if run.is_running else 'has ended'}"
        self._player.look()
        if not run.is_running and self._player.is_live and not self._is_told:
            self._compare(run)

    def _compare(self, run: Run) -> None:
        """Say what the run has shown of its question, and why."""
        self._is_told = True
        self._show_hint()
        self._why.set_visibility(bool(self._why.text) and run.has_finished)
        question = self._experiment.question if self._experiment is not None else None
        if question is None:
            return
        said = question.verdict(self._asked, run.seen) if run.has_finished else "It did not come to its end."
        self._verdict.text = said
        self._verdict.set_visibility(True)


class QuestionsPage:
    """The lab's last page: ten questions, each with three choices, and the docs' answer after a choice."""

    def __init__(self, lab: Lab) -> None:
        self._status = _bar("/lab/questions")
        self._right: dict[int, bool] = {}
        with ui.element("main").classes("rr-page column"):
            _heading("Ten questions", 1)
            ui.label("The page docs/let-it-crash.md, and the experiments, answer them.")
            for number, asked in enumerate(QUESTIONS, 1):
                self._ask(number, asked, lab)
        self._count()

    def _ask(self, number: int, asked: Asked, lab: Lab) -> None:
        text = asked.text.replace("`", "")
        with ui.element("section").classes("rr-panel w-full").props(f'aria-label="question {number}"'):
            ui.label(f"{number}. {text}").classes("text-bold")
            choices = ui.radio(asked.shown).props(f'inline aria-label="answers to question {number}"')
            said = ui.label().props('role="status"')
            if asked.experiment in lab.experiments:
                ui.link("the experiment that shows it", f"/lab?experiment={asked.experiment}")

        def choose() -> None:
            said.text = asked.verdict(str(choices.value)).replace("`", "")
            self._right.setdefault(number, choices.value == asked.choices[0])
            self._count()

        choices.on_value_change(choose)

    def _count(self) -> None:
        self._status.text = f"{sum(self._right.values())} of {len(QUESTIONS)} right at the first choice"

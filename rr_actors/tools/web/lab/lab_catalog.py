"""The experiments of the lab, in the order of the page.

To add one, put its program beside the others, and declare it here. The program is a module below
rr_actors/tools/experiments with a docstring and `def main(state_dir, ...)`. Each lever is a parameter of main(). The
run itself answers the question: an answer is right if its sign is among the run's events or printed lines.
"""

from __future__ import annotations

from rr_actors.tools.web.lab.lab_declarations import Happens, LabExperiment, Lever, NothingElse, Prints, Question

_CHILD = Lever("child", "killed child", ("b", "a", "c"))

EXPERIMENTS = (
    LabExperiment(
        "supervision.four_strategies",
        (_CHILD,),
        Question(
            "Which children will start again under rest_for_one?",
            {id: Happens("restarted", f"root/rest_for_one/{id}") for id in "abc"},
        ),
    ),
    LabExperiment(
        "supervision.your_own_tree",
        (
            Lever("strategy", "strategy", ("one_for_one", "one_for_all", "rest_for_one")),
            Lever("max_restarts", "intensity: restarts within 60 s", (2, 0, 1, 3)),
            Lever("kills", "kills", (1, 2, 3, 4)),
            _CHILD,
        ),
        Question(
            "What will the supervisor team do?",
            {
                **{f"restart {id}": Happens("restarted", f"root/team/{id}") for id in "abc"},
                "give up": Happens("restarted", "root/team"),
            },
        ),
    ),
    LabExperiment(
        "supervision.restart_storm",
        (Lever("max_restarts", "intensity: restarts within 15 s", (3, 1, 2)),),
        Question(
            "The child broken fails again and again. Which of them will give up?",
            {
                "branch": Happens("restarted", "root/branch"),
                "root, too": Prints("the tree has ended: shutdown"),
                "none of them": NothingElse(),
            },
        ),
    ),
    LabExperiment(
        "supervision.escalation_levels",
        (Lever("kills", "kills", (4, 1, 2, 3)),),
        Question(
            "The motor is killed. Which supervisors will be started again in the end?",
            {
                "wheel": Happens("restarted", "root/base/wheel"),
                "base": Happens("restarted", "root/base"),
                "none: the motor alone": NothingElse(),
            },
        ),
    ),
    LabExperiment(
        "supervision.back_off",
        (Lever("factor", "factor", (2.0, 1.0)), Lever("jitter", "jitter", (0.0, 0.5))),
        Question(
            "The first wait is 1 s. How long will the third one be?",
            {
                "about 1 s": Prints("wait 3: about 1 s"),
                "2 to 3 s": Prints("wait 3: 2 to 3 s"),
                "about 4 s": Prints("wait 3: about 4 s"),
            },
        ),
    ),
    LabExperiment(
        "supervision.poisoned_actor",
        question=Question(
            "The parser's process ends at the poison. What will its new process do with this message?",
            {"get it again, and end again": Prints("two: no answer"), "never see it": Prints("two: TWO")},
        ),
    ),
    LabExperiment(
        "supervision.frozen_child",
        (Lever("heartbeat_s", "heartbeat in seconds; 0 is none", (1.0, 3.0, 0.0)),),
        Question(
            "The process stands still for 6 s. What will become of it?",
            {
                "another process takes its place": Happens("restarted", "root/lidar"),
                "it goes on after that": NothingElse(),
            },
        ),
    ),
    LabExperiment(
        "sharing_and_parts",
        question=Question(
            "Two consumers load the same camera. How many cameras will be loaded?",
            {"one": Prints("one resource: True"), "two": Prints("one resource: False")},
        ),
    ),
    LabExperiment(
        "kill_in_a_load",
        question=Question(
            "The manager is killed while it loads. What will the consumer get?",
            {"the map, a little later": Prints("loaded: the map"), "an error": NothingElse()},
        ),
    ),
    LabExperiment(
        "handled_status",
        (Lever("handled", "the cameras' manager handles the status", ("yes", "no")),),
        Question(
            "The lens becomes dirty. Who will hear of it?",
            {
                "the cameras' manager": Prints("the cameras' manager hears"),
                "the consumer": Prints("the consumer hears"),
            },
        ),
    ),
    LabExperiment(
        "refused_ring",
        question=Question(
            "The map loads the camera, and the camera loads the map. What will the consumer get?",
            {
                "nothing: it waits for ever": NothingElse(),
                "an error that names the ring": Prints("refused: "),
                "the map": Prints("loaded: the map"),
            },
        ),
    ),
    LabExperiment(
        "crash_in_unload",
        question=Question(
            "The manager is killed while it closes a file. What will become of the file?",
            {
                "its unload runs again": Prints("closes the file, attempt 2"),
                "it stays open": NothingElse(),
                "the consumer holds it again": Prints("held again"),
            },
        ),
    ),
    LabExperiment(
        "planning.brownout",
        (
            Lever("priority", "priority of the pump, which needs 40 W", (9, 2)),
            Lever("capacity", "then as much is left, in W", (60, 80, 40)),
        ),
        Question(
            "Five devices of priorities 1 to 5 use all there is, 20 W each. Which are switched off for the pump?",
            {
                **{name: Prints(f"{name} is switched off for the pump") for name in ("radio", "lamp", "camera", "arm")},
                "nobody: the pump waits": NothingElse(),
            },
        ),
    ),
    LabExperiment(
        "planning.generator",
        (Lever("fuel", "the generator has fuel", ("yes", "no")),),
        Question(
            "All 100 W are used, and the pump needs 40 more. What will happen?",
            {
                "the generator starts, and nobody is switched off": Prints("the generator runs"),
                "the arm, of the highest priority, is switched off": Prints("arm is switched off for the pump"),
                "the radio and the lamp are switched off": Prints("lamp is switched off for the pump"),
            },
        ),
    ),
    LabExperiment(
        "planning.tour_guide",
        (
            Lever("idle", "what becomes of an idle program", ("pause", "unload")),
            Lever("linger_s", "seconds until that", (0.5, 30.0)),
        ),
        Question(
            "The guide has driven, and now explains. What has become of the laser's program?",
            {
                "it is paused": Prints("explain: laser is paused"),
                "it has been ended": Prints("explain: laser is not there"),
                "it runs on": Prints("explain: laser is loaded"),
            },
        ),
    ),
    LabExperiment(
        "planning.rebinding",
        (
            Lever("settle_s", "seconds that the camera has to be well before it is used again", (3.0, 30.0)),
            Lever("at_least_hz", "readings in a second that the consumer needs", (10, 50)),
        ),
        Question(
            "A loop reads the camera, until that is killed. What will the loop read then?",
            {
                "the lidar, and later the camera again": Prints("it has read: camera, lidar, camera."),
                "the lidar, to the end": Prints("it has read: camera, lidar."),
                "nothing: it ends with an error": Prints("the loop ends: "),
            },
        ),
    ),
    LabExperiment(
        "planning.keep",
        (
            Lever("fault", "what becomes of radio 0", ("killed", "silent")),
            Lever("delay_s", "seconds before what was lost is loaded again", (2.0, 20.0)),
            Lever("then_wanted", "then so many radios are wanted", (1, 5)),
        ),
        Question(
            "Three radios are wanted, and radio 0 fails. What will be there eight seconds later?",
            {
                "radio 0, radio 1 and radio 2": Prints("later: radio 0, radio 1, radio 2"),
                "radio 1, radio 2, and radio 3 as a new one": Prints("later: radio 1, radio 2, radio 3"),
                "radio 1 and radio 2": Prints("later: radio 1, radio 2 ("),
            },
        ),
    ),
    LabExperiment(
        "planning.umrf",
        (
            Lever("broken", "the broken camera", ("arm", "none", "spare")),
            Lever("killed", "what is killed during a picture", ("nobody", "actions")),
        ),
        Question(
            "A picture is to be taken with the arm's camera, or else with the spare one. What will happen?",
            {
                "the spare camera takes it": Prints("TakePicture_1 is FINISHED"),
                "the graph ends with an error": Prints("the graph ends with on_error"),
                "the drive runs again": Prints("Drive begins, attempt 2"),
                "the spare camera begins again, as attempt 2": Prints("the camera spare, attempt 2"),
            },
        ),
    ),
)
"""All experiments."""


def experiment_called(name: str) -> LabExperiment | None:
    """Return the experiment of that name, if there is one."""
    return next((one for one in EXPERIMENTS if one.name == name), None)

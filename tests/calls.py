"""A sound call of every public function that takes tensors, arrays or numbers, and who is exempt from having one.

`test_every_bad_input` makes the calls wrong. Arguments that cannot be wrong on their own (a table, a model) stand there
because a call needs them.
"""

from tests import calls_guidance, calls_world

CALLS = [*calls_world.CALLS, *calls_guidance.CALLS]

# Modules whose numbers are looked at elsewhere, or are nobody's argument, and why.
COMMAND = "a command: its numbers are keys of a yaml, which `cli.require_*` and its own `check` look at"
DRAWN = "draws or writes down what others have measured"
HAND = "acts on a hand, where what is wrong must end in no force, not in an exception; see test_safety, test_hostile"
ROUTE = "passes on what it is given, to files or to other processes"
ELSEWHERE = {
    **dict.fromkeys((f"airhockey_marl.{name}" for name in ("compare", "grid", "league_report", "train")), COMMAND),
    **dict.fromkeys((f"airhockey_marl.{name}" for name in ("board", "figures", "findings", "page", "report")), DRAWN),
    **dict.fromkeys((f"airhockey_marl.{name}" for name in ("files", "launchers", "lock", "run_record")), ROUTE),
    "airhockey_marl.checks": "is what refuses",
    "airhockey_marl.cli": COMMAND,
    "airhockey_marl.exploit": "takes a configuration; counts and seed are looked at like those of `match`",
    "airhockey_marl.guards": "refuses numbers that are wrong by a FloatingPointError; see test_guards",
    "airhockey_marl.parallel": "starts compiled code of callers who have looked at what it is given",
    **dict.fromkeys(
        (
            f"guidance.{name}"
            for name in (
                "battery",
                "calibrate",
                "collect",
                "evaluate",
                "lab",
                "meta_train",
                "play",
                "prediction_report",
            )
        ),
        COMMAND,
    ),
    **dict.fromkeys((f"guidance.{name}" for name in ("replicate", "runs", "watch", "provenance")), COMMAND),
    **dict.fromkeys((f"guidance.{name}" for name in ("answers", "drawing", "figures", "groups", "portraits")), DRAWN),
    **dict.fromkeys((f"guidance.{name}" for name in ("report", "robustness", "window")), DRAWN),
    **dict.fromkeys((f"guidance.{name}" for name in ("clock", "devices", "safety", "seat", "servo")), HAND),
    **dict.fromkeys((f"guidance.{name}" for name in ("lsl", "recording", "records", "session", "seating")), ROUTE),
    "guidance.examples": "is read rather than called",
}
# Functions without a call, and why.
NO_CALL = {
    "guidance.games.no_force": "looks at the number of games only",
    "guidance.guide.Plan": "is made by `Guide`, which has looked at the games",
    "guidance.study.run_study": "hands everything on to `run_studies`",
    "guidance.study.run_studies": "hands everything on to `Guide`, `Users` and `play_games`, whose errors are its own",
    "guidance.ticks.TickLog": "writes a number down as it is",
    "guidance.users.laws.LogNormal.draw": "of a law that `laws.checked` has passed",
}


# What a wrong argument is called in the error: by another name where the function that looks at it has one.
CALLED_OTHERWISE: dict[str, str] = {}
# What is no error, and why.
LAWFUL: dict[str, tuple[str, ...]] = {}

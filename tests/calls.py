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
MODULES = {
    "airhockey_marl": {
        COMMAND: "cli compare grid league_report train",
        DRAWN: "board figures findings page report",
        ROUTE: "cluster files kept_config launchers lock run_record",
        "is what refuses": "building checks",
        "takes a configuration; counts and seed are looked at like those of `match`": "exploit",
        "refuses numbers that are wrong by a FloatingPointError; see test_guards": "guards",
        "starts compiled code of callers who have looked at what it is given": "parallel",
    },
    "guidance": {
        COMMAND: "battery calibrate collect evaluate lab meta_train play prediction_report replicate runs watch",
        DRAWN: "answers drawing figures groups portraits provenance report robustness window",
        HAND: "clock devices safety seat servo",
        ROUTE: "lsl recording records seating session",
        "is read rather than called": "examples",
    },
}
ELSEWHERE = {
    f"{package}.{name}": reason
    for package, reasons in MODULES.items()
    for reason, names in reasons.items()
    for name in names.split()
}
# Functions without a call, and why.
NO_CALL = {
    "guidance.conditions.NoGuidance.__call__": "has no force for whatever it is given",
    "guidance.games.no_force": "looks at the number of games only",
    "guidance.guide.Plan": "is made by `Guide`, which has looked at the games",
    "guidance.study.run_study": "hands everything on to `run_studies`",
    "guidance.study.run_studies": "hands everything on to `Guide`, `Users` and `play_games`, whose errors are its own",
    "airhockey_marl.collecting.TablesCollector.begin": "is told by `Crew`, in whose process it may not be",
    "airhockey_marl.collecting.TablesCollector.follow": "likewise",
    "airhockey_marl.match.answer": "asks with what `Tables.observe` has written",
    "airhockey_marl.render.View.box": "of a picture that `draw_table` was asked for",
    "airhockey_marl.render.View.pixel": "likewise",
    "airhockey_marl.render.draw_bodies": "likewise",
    "guidance.models.Models.load": "reads files, after which `League.player` looks at the generation",
    "guidance.users.anchors.anchor_scales": "hands everything on to `play_anchor`",
    "guidance.users.population.Population": "hands every field to `laws.checked`; see test_users",
    "guidance.ticks.TickLog": "writes a number down as it is",
    "guidance.users.laws.LogNormal.draw": "of a law that `laws.checked` has passed",
}

HANDS = [
    *(f"guidance.conditions.{name}.__call__ action" for name in ("Toward", "Combined", "Product", "Blended")),
    *(f"guidance.conditions.{name} action" for name in ("Toward.pull", "Spring.force")),
    "guidance.ticks.Overheard.__call__ action",
]
INDICES = [f"airhockey_marl.league.League.{name} index" for name in ("generation", "until", "player")]
# What a wrong argument is called in the error, where that is the name by which another function knows it.
CALLED_OTHERWISE = {
    "airhockey_marl.tables.Tables n": "tables",
    "airhockey_marl.env.AirHockeyTables n": "tables",
    **dict.fromkeys(INDICES, "generation"),
    **dict.fromkeys(HANDS, "position"),  # where a spring has its end, in metres
    "guidance.guide.Guide lookahead_seconds": "guidance.lookahead",
    "guidance.ticks.overheard_guide lookahead_seconds": "guidance.lookahead",
    "guidance.sensitivity.latin_hypercube points": "sensitivity.points",
    "guidance.users.sampling.sample_people n": "people",
}
# What would be wrong elsewhere, and is none here: a function that works on any device, or takes any seed.
ANY_DEVICE = (
    "airhockey_marl.shaping.Shaping.potential observation",
    "airhockey_marl.shaping.on_goal observation",
    "guidance.forces.lookahead state",
    "guidance.forces.uncertainty_weight std",
    "guidance.models.Models.anticipated state",
)
ANY_SEED = (
    *(f"airhockey_marl.match.{name} seed" for name in ("play_rounds", "play_matches", "play_match")),
    "airhockey_marl.env.AirHockey.reset seed",
    "airhockey_marl.defence.defence seed",
    "airhockey_marl.tables.Tables.seed seed",
)
LAWFUL = {
    **dict.fromkeys(ANY_DEVICE, ("device",)),
    **dict.fromkeys((*ANY_SEED, *INDICES, "airhockey_marl.ratings.rate reference"), ("negative",)),
    **dict.fromkeys((*HANDS, "guidance.conditions.Spring.force target"), ("dtype",)),
    "airhockey_marl.sac.SAC target_entropy": ("negative",),
    "airhockey_marl.trpo.conjugate_gradient b": ("shape",),  # of any length
    "guidance.styles.told_apart styles": ("dtype",),  # names will do
    "guidance.users.laboratory.onset speed": ("shape",),  # fewer ticks
    "guidance.users.laboratory.push_response newtons": ("negative",),  # to the other side
}
# What is neither: any device will do that has values, as "meta" has not.
UNKNOWABLE = {"airhockey_marl.trpo.conjugate_gradient b": ("device",)}

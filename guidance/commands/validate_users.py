"""Validate the simulated people on human motor tasks, playstyles and anchor forces, before any guidance.

    airhockey validate_users                              40 people in the laboratory, 120 at the table
    airhockey validate_users users.variant=goal_sharing   another response to forces
    airhockey validate_users +preset=smoke                seconds, to see that it runs

Prints each measure beside the human range and its source, and the rating proxies under the anchor forces. Writes into
its run folder human_measures.csv (the measures), anchors.csv (ratings and signals under each force), anchors.yaml (the
`scales` and `withdrawn` proxies of conf/users that follow from them, for the spring of conf/guidance) and five figures:
speeds.png (speed profiles of reaches), push.png (displacement of the hand by a force), places.png (where each playstyle
keeps its paddle), shots.png (velocities of the puck after a stroke) and anchors.png (ratings over the force).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.files import write_text
from airhockey_marl.experiment.registry import construct
from airhockey_marl.experiment.run_folder import output_folder

if TYPE_CHECKING:
    from guidance.forces.conditions import Spring
    from guidance.simulated_users import Population
    from guidance.study.setup import PlaySetup


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "laboratory", "per_style", least=2)
    require_counts(cfg, "anchors.groups")
    require_numbers(cfg, "play_seconds", "anchors.seconds", least=10.0)
    require_numbers(cfg, "guidance.spring.stiffness", "guidance.spring.limit")


def main(cfg: DictConfig) -> None:
    import numpy as np

    from guidance.forces.conditions import Spring
    from guidance.simulated_users import load_population, sample_people
    from guidance.simulated_users.force_response import Variant
    from guidance.simulated_users.validation.figures import draw_places, draw_push, draw_shots, draw_speeds
    from guidance.simulated_users.validation.measures import as_table, in_the_laboratory, style_measures
    from guidance.simulated_users.validation.motor_tasks import push_response
    from guidance.study.demonstrations import collect_demonstrations, results_by_skill
    from guidance.study.setup import load_play_setup
    from guidance.user_model.data import Demonstrations, hand_speed

    with report_input_errors():
        population, setup = load_population(cfg.users), load_play_setup(cfg)
        spring = construct(Spring, cfg.guidance.spring, "guidance.spring")
    people = sample_people(cfg.laboratory, cfg.seed, population)
    results, data = in_the_laboratory(people, cfg.users.variant, cfg.seed, setup.adaptation)

    table, names = setup.table, list(population["archetypes"])

    def games(seed: int) -> list[Demonstrations]:
        """Two games of each of `per_style` people of each archetype."""
        groups = [sample_people(cfg.per_style, seed, population, name) for name in names]
        ticks = round(cfg.play_seconds / table.tick)
        return [collect_demonstrations(group, setup, 2, ticks, seed) for group in groups]

    references, others = games(cfg.seed + 100), games(cfg.seed + 200)
    speeds = [hand_speed(data.observation, data.action, table).numpy().ravel() for data in others]
    results["speed of the hand in play, 99.9 %"] = np.array([np.percentile(np.concatenate(speeds), 99.9)])
    results |= style_measures([d.observation for d in references], [d.observation for d in others], table)
    results |= results_by_skill(population, 6 * cfg.per_style, setup, cfg.seed)
    rows, play = as_table(results), {name: d.observation[:, 0] for name, d in zip(names, others, strict=True)}
    folder = output_folder(cfg)
    write_text(folder / "human_measures.csv", rows.to_csv(index=False))
    pushed = {
        name: push_response(people, name, seed=cfg.seed, adaptation=setup.adaptation) for name in Variant.__members__
    }
    draw_speeds(data, folder / "speeds.png")
    draw_push(pushed, folder / "push.png")
    draw_places(play, table, folder / "places.png")
    draw_shots(play, table, folder / "shots.png")
    print(rows.to_string(index=False, float_format=lambda number: f"{number:.3g}"))
    with report_input_errors():
        print(under_anchor_forces(cfg, spring, population, setup, folder))
    print(f"figures and tables: {folder}")


def under_anchor_forces(cfg: DictConfig, spring: Spring, population: Population, setup: PlaySetup, folder: Path) -> str:
    """Play the games under the anchor forces, write their files, and return what they say about the rating proxies."""
    import numpy as np

    from guidance.simulated_users import training_people
    from guidance.simulated_users.force_response import Variant
    from guidance.simulated_users.validation.figures import draw_anchors
    from guidance.simulated_users.validation.rating_anchors import anchor_results, anchor_signals

    primary = cfg.users.variant
    people = np.concatenate([training_people(cfg.seed + group, population) for group in range(cfg.anchors.groups)])
    game = {"seconds": cfg.anchors.seconds, "seed": cfg.seed, "advisors": setup.advisors}
    signals = {variant: anchor_signals(people, spring, variant=variant, **game) for variant in Variant.__members__}
    found = anchor_results(signals, primary)
    write_text(folder / "anchors.csv", found.table.to_csv(index=False))
    write_text(folder / "anchors.yaml", found.as_yaml(primary))
    draw_anchors(found.table[found.table["variant"] == primary], folder / "anchors.png")
    lines = [f"\nPROXIES of ratings under the anchor forces at full strength, of {len(people)} training users"]
    lines.append(found.full_strength().to_string(index=False, float_format=lambda number: f"{number:.2f}"))
    for variant, ratings in found.failures.items():
        failed = [f"{name} ({', '.join(reasons)})" for name, reasons in ratings.items() if reasons]
        lines.append(f"fail the known order under {variant}: {'; '.join(failed) or 'none'}")
    return "\n".join([*lines, "", found.as_yaml(primary)])

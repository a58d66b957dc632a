"""Validate the simulated people on human motor tasks and playstyles, before any guidance.

    airhockey validate_users                              40 people in the laboratory, 120 at the table
    airhockey validate_users users.variant=goal_sharing   another response to forces
    airhockey validate_users +preset=smoke                seconds, to see that it runs

Prints each measure beside the human range and its source. Writes human_measures.csv (the same) and four figures into
its run folder: speeds.png (speed profiles of reaches), push.png (displacement of the hand by a force), places.png
(where each playstyle keeps its paddle) and shots.png (velocities of the puck after a stroke).
"""

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts, require_numbers
from airhockey_marl.experiment.files import write_text
from airhockey_marl.experiment.run_folder import output_folder


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "laboratory", "per_style", least=2)
    require_numbers(cfg, "play_seconds", least=10.0)


def main(cfg: DictConfig) -> None:
    import numpy as np

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
    print(f"\nfigures: {folder}")

"""Compare algorithms by the leagues they trained: against scripted players, their first generation, and each other.

    airhockey train -m algorithm=trpo,ppo,sac seed=0,1,2     nine runs, one after another
    airhockey compare runs=outputs/train/<date>/<time>-sweep

Of each run, five generations (the first, the last and the quarters between) play the scripted players and their own
generation 0, and the last generations of all runs play each other. All sample their actions, as in training. Writes
comparison.csv, a row per match and side, and comparison.png into its run folder, and prints a table.
"""

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts
from airhockey_marl.experiment.files import find_files, write_text
from airhockey_marl.experiment.run_folder import output_folder


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "rounds")


def main(cfg: DictConfig) -> None:
    from airhockey_marl.evaluation.comparison import (
        LEAGUE_FILE,
        check_runs,
        compare,
        comparison_figure,
        read_run,
        screen_table,
    )
    from airhockey_marl.experiment.plotting import save_png

    with report_input_errors():
        runs = [read_run(file.parent) for file in find_files(cfg.runs, LEAGUE_FILE)]
        check_runs(runs)
    folder, results = output_folder(cfg), compare(runs, cfg.rounds, cfg.seed)
    write_text(folder / "comparison.csv", results.to_csv(index=False))
    save_png(comparison_figure(results), folder / "comparison.png", dpi=150)
    print(screen_table(results))
    print(f"\n{folder / 'comparison.csv'}\n{folder / 'comparison.png'}")

"""Compare algorithms by the leagues they trained: against scripted players, their first generation, and each other.

    airhockey train -m algorithm=trpo,ppo,sac seed=0,1,2     nine runs, one after another
    airhockey compare runs=outputs/train/<date>/<time>-sweep

Of each run, five generations (the first, the last and the quarters between) play the scripted players and their own
generation 0, and the last generations of all runs play each other. All sample their actions, as in training. Writes
comparison.csv, a row per match and side, and comparison.png into its run folder, and prints a table.
"""

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors, require_counts
from airhockey_marl.experiment.files import atomic_write, find_files


def check(cfg: DictConfig) -> None:
    require_counts(cfg, "rounds", "threads")
    require_counts(cfg, "seed", least=0)


def main(cfg: DictConfig) -> None:
    """Play the matches, write them down and draw them."""
    import torch

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
        places = [cfg.runs] if isinstance(cfg.runs, str) else cfg.runs
        runs = [read_run(file.parent) for file in find_files(places, LEAGUE_FILE)]
        check_runs(runs)
    torch.set_num_threads(cfg.threads)
    folder = Path(cfg.out or HydraConfig.get().runtime.output_dir)
    results = compare(runs, cfg.rounds, cfg.seed)
    with atomic_write(folder / "comparison.csv") as path:
        results.to_csv(path, index=False)
    save_png(comparison_figure(results), folder / "comparison.png", dpi=150)
    print(screen_table(results))
    print(f"\n{folder / 'comparison.csv'}\n{folder / 'comparison.png'}")

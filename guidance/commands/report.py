"""Report a study: the paper's tables and Figure 6 with the paper's numbers beside ours.

    airhockey report runs=outputs/evaluate/...     every trials.csv below: one run, or the runs of a sweep
    airhockey report runs=... beside=...           two groups side by side, such as people and simulated people

A trials.csv may also be one that R, Excel or another program has written, see guidance/study/README.md. Writes
tests.csv, figure6.png and .svg, and report.html; with `beside` also beside.png and .svg.
"""

from omegaconf import DictConfig

from airhockey_marl.experiment.command import report_input_errors
from airhockey_marl.experiment.run_folder import output_folder


def main(cfg: DictConfig) -> None:
    from guidance.statistics.groups import gather
    from guidance.statistics.paper import count_findings
    from guidance.statistics.report import screen_table, write_report

    folder = output_folder(cfg)
    with report_input_errors():
        group = gather(cfg.runs, cfg.mixed)
        try:
            beside = None if cfg.beside is None else gather(cfg.beside, cfg.mixed)
        except ValueError as error:
            raise ValueError(f"beside: {error}") from error
        if beside:
            digests, others = group.manifest["trials_sha256"], beside.manifest["trials_sha256"]
            if common := [file for file, digest in others.items() if digest in digests.values()]:
                files = ", ".join(common)
                raise ValueError(f"beside = {cfg.beside} has the same games as runs = {cfg.runs}: {files}")
    write_report(group.trials, folder, group.manifest, beside)
    print(screen_table(group))
    counts = count_findings(group.comparison)
    total, others = counts.loc["all"], counts.loc["none"]
    print(f"\n{total.replicated} of the paper's 38 findings replicate ({total.tested} tested),", end=" ")
    print(f"{total.reversed} reversed; {others.false_positives} of its 63 non-findings are significant here")
    if beside:
        total = count_findings(beside.comparison).loc["all"]
        print(f"beside: {total.replicated} replicate ({total.tested} tested), {total.reversed} reversed")
    print(f"report: {folder / 'report.html'}")

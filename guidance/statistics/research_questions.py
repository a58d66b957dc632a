"""Answers to the four research questions (section 4.1) in sentences, from significant pairs of ours or of the paper."""

from typing import NamedTuple

import pandas as pd

from guidance.statistics.design import METRICS

PERFORMANCE = ("win_rate", "mean_smash_speed", "defense_rate")


class Contrast(NamedTuple):
    """A comparison of a research question: `subject` names the change from condition `old` to `new` (letters)."""

    subject: str
    new: str
    old: str
    metrics: tuple[str, ...] = tuple(METRICS)


QUESTIONS = {
    "RQ1": "Do the UT, UA, and SC methods contribute to an improvement in HG performance?",
    "RQ2": "Do OAHG, UPHG, and CombHG improve users' task performance when compared to NHG?",
    "RQ3": "What differences do OAHG and UPHG have in users' objective and subjective evaluations?",
    "RQ4": "Can CombHG, which integrates OAHG and UPHG, complement each HG or provide better effects?",
}
CONTRASTS = {
    "RQ1": [
        Contrast("UT in OAHG", "c", "b"),
        Contrast("UA in UPHG", "e", "d"),
        Contrast("UT in UPHG", "f", "e"),
        Contrast("UT with UA in UPHG", "f", "d"),
        Contrast("SC in CombHG", "h", "g"),
        Contrast("UT in CombHG", "i", "h"),
        Contrast("UT with SC in CombHG", "i", "g"),
    ],
    "RQ2": [
        Contrast("OAHG", "c", "a", PERFORMANCE),
        Contrast("UPHG", "f", "a", PERFORMANCE),
        Contrast("CombHG", "i", "a", PERFORMANCE),
    ],
    "RQ3": [Contrast("UPHG, set against OAHG,", "f", "c")],
    "RQ4": [Contrast("CombHG, set against OAHG,", "i", "c"), Contrast("CombHG, set against UPHG,", "i", "f")],
}


def answer_questions(pairs: pd.DataFrame, people: bool = False) -> dict[str, list[str]]:
    """Answers to RQ1-RQ4, a sentence per contrast.

    Args:
        pairs: `metric`, `x`, `y` (letters), `greater` (the letter with the significantly larger mean, "" if the
            means do not differ significantly) and `tested` (bool), one row per pair and metric.
        people: the ratings are of people; otherwise they are marked as proxies.

    Returns:
        question -> sentences, such as "UA in UPHG raises helpfulness (PROXY) and controllability (PROXY).".
    """
    return {
        question: [_sentence(contrast, pairs, people) for contrast in CONTRASTS[question]] for question in QUESTIONS
    }


def _sentence(contrast: Contrast, pairs: pd.DataFrame, people: bool) -> str:
    matches = [set(pair) == {contrast.new, contrast.old} for pair in zip(pairs["x"], pairs["y"], strict=True)]
    tested = pairs[matches]
    tested = tested[tested["metric"].isin(contrast.metrics) & tested["tested"]]
    if tested.empty:
        return f"{contrast.subject} was not tested."
    changes = [
        f"{verb} {_list(tested.loc[tested['greater'] == letter, 'metric'], people)}"
        for verb, letter in (("raises", contrast.new), ("lowers", contrast.old))
        if (tested["greater"] == letter).any()
    ]
    return f"{contrast.subject} {' and '.join(changes) or 'changes nothing significantly'}."


def _list(metrics: pd.Series, people: bool) -> str:
    names = [
        METRICS[metric].label.lower() + (" (PROXY)" if METRICS[metric].kind == "subjective" and not people else "")
        for metric in METRICS
        if metric in set(metrics)
    ]
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))

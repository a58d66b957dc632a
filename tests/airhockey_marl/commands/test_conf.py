"""The configuration: every file composes, every key is explained, no number stands twice."""

from itertools import pairwise

import hydra
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from airhockey_marl.experiment.command import CONF
from airhockey_marl.experiment.registry import construct
from guidance.simulated_users import Population

PRIMARY = sorted(path.stem for path in CONF.glob("*.yaml"))


def targets(node) -> list[str]:
    """Every `_target_` below a plain container."""
    if not isinstance(node, dict):
        return []
    inner = [found for value in node.values() for found in targets(value)]
    return [node["_target_"], *inner] if "_target_" in node else inner


@pytest.mark.parametrize("name", PRIMARY)
@pytest.mark.parametrize("preset", [[], ["smoke"]])
def test_every_command_composes_and_what_it_names_exists(name, preset):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose(name, overrides=[f"+preset/{name}={choice}" for choice in preset])
    for target in targets(OmegaConf.to_container(cfg)):
        assert callable(hydra.utils.get_object(target))


@pytest.mark.parametrize("group", ["algorithm", "league", "env", "condition", "study", "guidance", "users"])
def test_every_choice_of_a_group_composes(group):
    command = "train" if group in ("algorithm", "league", "env") else "evaluate"
    for path in (CONF / group).glob("*.yaml"):
        with initialize_config_dir(str(CONF), version_base="1.3"):
            assert compose(command, overrides=[f"{group}={path.stem}"])[group] is not None


def test_beginners_are_the_same_people_with_less_skill():
    usual, novice = (compose_evaluate(f"users={users}").users for users in ("default", "novice"))
    assert novice.population.style.skill_mean == -1.5
    novice.population.style.skill_mean = usual.population.style.skill_mean
    assert OmegaConf.to_container(novice) == OmegaConf.to_container(usual)


def compose_evaluate(*overrides: str):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("evaluate", overrides=list(overrides))


@pytest.mark.parametrize("name", PRIMARY)
def test_every_key_of_a_primary_yaml_is_explained_above_it(name):
    lines = (CONF / f"{name}.yaml").read_text(encoding="utf-8").splitlines()
    for before, line in pairwise(["", *lines]):
        if line and line[0].isalpha() and line.rstrip() not in ("defaults:", "models:"):
            assert before.startswith("#"), line


def test_the_yaml_of_the_population_is_the_population():
    cfg = OmegaConf.load(CONF / "users" / "default.yaml")
    assert construct(Population, cfg.population, "users.population").parameters == Population.default().parameters

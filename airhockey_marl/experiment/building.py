"""Objects from configurations: only of the classes that this project's yaml files are there to compose.

A `_target_` can name anything that Python can import, `os.system` among it, and a configuration can come from
elsewhere: with a run folder that is gone on with, or as a condition that somebody shares. So before anything of a
configuration is made, all its targets are looked at, wherever in it they are.
"""

from collections.abc import Iterator
from importlib import import_module
from typing import Any

import hydra
from omegaconf import DictConfig, ListConfig, OmegaConf

from airhockey_marl.experiment.command import InputError

FROM = (
    "guidance.forces.conditions",
    "airhockey_marl.league.opponent_sampling",
)  # every class that these define: what people compose
CLASSES = (
    "airhockey_marl.players.networks.Critic",
    "airhockey_marl.algorithms.ppo.PPOConfig",
    "airhockey_marl.algorithms.sac.SACConfig",
    "airhockey_marl.algorithms.trpo.TRPOConfig",
    "guidance.haptics.safety.SafetyLimits",
    "guidance.study.protocol.Protocol",
    "guidance.simulated_users.population.Population",
)


def build(node: DictConfig | ListConfig, **changes: Any) -> Any:
    """What `hydra.utils.instantiate` makes of a node, after a look at every target in it.

    Args:
        changes: values that take the place of the node's own.

    Raises:
        InputError: it names something else than the classes above; names where, and what. Nothing was imported.
    """
    if not OmegaConf.is_config(node):
        raise InputError(f"{node!r} must be a part of the configuration with a _target_")
    place = node._get_full_key("") or "configuration"
    for key, target in [*_targets(OmegaConf.to_container(node, resolve=True), place), *_targets(changes, place)]:
        if not allowed(target):
            raise InputError(f"{key} = {target} must be a class of {', '.join(FROM)}, or one of {len(CLASSES)} others")
    return hydra.utils.instantiate(node, **changes)


def allowed(target: Any) -> bool:
    """Whether a configuration may ask for this target."""
    if not isinstance(target, str):
        return False
    module, _, name = target.rpartition(".")
    if module not in FROM:
        return target in CLASSES
    found = vars(import_module(module)).get(name)
    return isinstance(found, type) and found.__module__ == module  # not what the module has imported


def _targets(content: Any, place: str) -> Iterator[tuple[str, Any]]:
    """Every target below `content`, with the key it stands at."""
    if isinstance(content, dict):
        for key, value in content.items():
            if key == "_target_":
                yield f"{place}._target_", value
            else:
                yield from _targets(value, f"{place}.{key}")
    elif isinstance(content, list | tuple):
        for index, value in enumerate(content):
            yield from _targets(value, f"{place}[{index}]")

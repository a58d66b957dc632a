"""The configurations that lie in run folders: anybody's, so that none may take more time or memory than it is long.

A few lines of yaml can mean a billion: aliases of lists of aliases, or `${references}` to texts of references, which
are resolved one by one. What Hydra writes has no aliases and a handful of references.
"""

from pathlib import Path

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import AliasEvent, CollectionStartEvent, NodeEvent, ScalarEvent, YAMLError

LARGEST = 100_000  # bytes; the largest that a command of ours writes has 7,000
DEEPEST = 30  # lists and tables within each other; ours have 5
MOST_REFERENCES = 16  # of all its texts; ours have 6. Each three of them can make it three times as much at most
LONGEST = 1000  # characters of a text with references, to read which takes longer than its length


def read_config(file: Path) -> DictConfig:
    """Read a configuration.

    Raises:
        ValueError: it is no yaml, no table, or more than it seems; names the file.
        OSError: it cannot be read.
    """
    with file.open("rb") as handle:
        content = handle.read(LARGEST + 1)
    if len(content) > LARGEST:
        raise ValueError(f"{file} is of more than {LARGEST} bytes, must be a configuration that a run has kept")
    try:
        text = content.decode("utf-8")
        if trouble := _swelling(text):
            raise ValueError(trouble)
        config = OmegaConf.create(text)
    except (YAMLError, ValueError, RecursionError, OmegaConfBaseException) as error:  # no UTF-8 is a ValueError, too
        raise ValueError(f"{file} is no yaml of ours: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(config, DictConfig):
        raise ValueError(f"{file} is no yaml of ours: it must be a table of keys and values")
    return config


def _swelling(text: str) -> str | None:
    """What in a yaml could make it larger than it looks; None if nothing does."""
    depth = references = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, AliasEvent) or (isinstance(event, NodeEvent) and event.anchor is not None):
            return f"line {event.start_mark.line + 1} has an alias or an anchor, must have none"
        if isinstance(event, NodeEvent):
            depth += isinstance(event, CollectionStartEvent)
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > DEEPEST:
            return f"line {event.start_mark.line + 1} is {depth} levels deep, must be at most {DEEPEST}"
        if isinstance(event, ScalarEvent) and "${" in event.value:
            references += event.value.count("${")
            if references > MOST_REFERENCES or len(event.value) > LONGEST:
                line = f"line {event.start_mark.line + 1}"
                return f"{line}: more than {MOST_REFERENCES} references, or in more than {LONGEST} characters"
    return None

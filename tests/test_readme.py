"""README: its Python snippets run, and the files that the READMEs link to exist."""

import os
import re
from itertools import chain
from pathlib import Path
from urllib.parse import unquote

import pytest

from tests import ROOT

READMES = sorted(
    path
    for path in chain(
        *(ROOT.glob(f"{folder}README*.md") for folder in ("", "*/", "*/*/")), (ROOT / ".github").glob("*.md")
    )
    if not path.is_relative_to(ROOT / "outputs")
)
SNIPPETS = re.findall(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)|<img[^>]* src=\"([^\"]+)\"")


@pytest.mark.parametrize("snippet", SNIPPETS, ids=[f"snippet {number}" for number in range(1, len(SNIPPETS) + 1)])
def test_snippets_run(snippet, tmp_path, monkeypatch):
    """Each in a namespace and an empty folder of its own."""
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet, "README.md", "exec"), {"__name__": "readme"})


@pytest.mark.parametrize("readme", READMES, ids=lambda path: str(path.relative_to(ROOT)))
def test_linked_files_exist(readme: Path):
    for groups in LINK.findall(re.sub(r"^```.*?^```$", "", readme.read_text(encoding="utf-8"), flags=re.M | re.S)):
        target = unquote("".join(groups)).partition("#")[0]
        if target and not re.match(r"[a-z]+:", target):
            file = Path(os.path.normpath(readme.parent / target))
            assert file.is_relative_to(ROOT) and file.exists(), f"{readme}: {target}"

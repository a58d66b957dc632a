"""The window of a game with a person, and films of recorded games."""

import os

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # keeps standard output to the command

"""The window a person plays in: the table, the pages of a study, and what is pressed."""

import os

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # standard output is the command's

"""`python -m guidance.evaluate`: see `guidance.commands.evaluate`."""

from airhockey_marl.experiment.command import run

if __name__ == "__main__":
    run("guidance.commands.evaluate")

"""`python -m airhockey_marl.train`: see `airhockey_marl.commands.train`."""

from airhockey_marl.experiment.command import run

if __name__ == "__main__":
    run("airhockey_marl.commands.train")

"""`python -m airhockey_marl.train`: see `airhockey_marl.commands.train`."""

from airhockey_marl.commands.train import main

if __name__ == "__main__":
    main()

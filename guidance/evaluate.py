"""`python -m guidance.evaluate`: see `guidance.commands.evaluate`."""

from guidance.commands.evaluate import main

if __name__ == "__main__":
    main()

"""`python -m guidance`: lists the commands; `python -m guidance <command> key=value ...` runs one."""

from airhockey_marl.__main__ import main

if __name__ == "__main__":
    main()

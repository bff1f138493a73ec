"""``python -m corrsfm``."""

from corrsfm.cli import main

if __name__ == "__main__":
    main(prog_name="corrsfm")

"""``python -m pbcgen``."""

from pbcgen.cli import main

if __name__ == "__main__":
    main()

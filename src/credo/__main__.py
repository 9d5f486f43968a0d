"""`python -m credo` is `credo`."""

from .cli import main

if __name__ == "__main__":
    main()

"""``python -m naibu`` does what the command ``naibu`` does."""

from naibu.cli import main

if __name__ == "__main__":
    main()

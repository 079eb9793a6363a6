"""``python -m lbt_synth`` is ``lbt-synth``."""

from lbt_synth.cli.main import entry_point

if __name__ == "__main__":
    entry_point()

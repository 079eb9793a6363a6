"""The configuration of the robust example, with other sections of the design."""

from support.plants import ROOT

EXAMPLE = ROOT / "examples" / "lbt_robust.yaml"
SMALL = """
  robust:
    turbulence: model
    bands:
      - {low_hz: 19.0, high_hz: 21.0, rms_mas: 10.0}
    functions: 16
    states: null
"""


def robust_writer(tmp_path):
    """Function that writes the example with another design section, and returns its path."""
    text = EXAMPLE.read_text()
    start, end = text.index("design:"), text.index("simulation:")
    path = tmp_path / "small.yaml"

    def write(section=SMALL, **changes):
        out = text[:start] + "design:" + section + "\n" + text[end:]
        for old, new in changes.values():
            assert old in out
            out = out.replace(old, new)
        path.write_text(out)
        return str(path)

    return write

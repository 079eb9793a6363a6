"""The command explore: a page of sliders in the browser, served from here."""

from __future__ import annotations

import re
import sys
from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.loop_inputs import load_designs, load_shown
from lbt_synth.cli.output import Report
from lbt_synth.errors import ProblemError
from lbt_synth.report.explore.exploration import explore, new_view
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.validation import integer

_LOCAL = ("localhost", "127.0.0.1", "::1")


def run(arguments: Namespace) -> Report:
    """Serve the page until it is interrupted."""
    integer(arguments.port, "--port", at_least=0, at_most=65_535)
    for origin in arguments.origin:
        if not re.fullmatch(r"[\w.*-]+:\d{1,5}", origin):
            raise ProblemError(f"--origin must be HOST:PORT, as localhost:8080; got {origin!r}.")
    folder = Path(arguments.output)
    require_writable(folder / "explored-1.yaml")
    config = load_shown(arguments)
    exploration = explore(config, load_designs(arguments.gains))
    first = new_view(exploration)

    from lbt_synth.report.explore.server import serve  # bokeh's server, slow to import

    served = []

    def announce(url: str) -> None:
        stream = sys.stderr if arguments.json else sys.stdout
        print(f"Open {url} in a browser. Ctrl-C ends.", file=stream, flush=True)
        if arguments.host not in _LOCAL:
            print(
                "note: whoever reaches this address can use the page and write new files into "
                f"{folder}.",
                file=stream,
                flush=True,
            )
        served.append(url)

    saved = serve(
        exploration,
        first,
        folder,
        host=arguments.host,
        port=arguments.port,
        origins=arguments.origin,
        announce=announce,
    )
    report = Report(data={"url": served[0]})
    report.note_files(saved)
    return report

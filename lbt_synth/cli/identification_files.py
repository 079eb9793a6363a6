"""What identify and auto write: the places of their files, and the text of a model."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from lbt_synth.config import identified_config
from lbt_synth.config.write import config_text
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.identification import (
    IdentifiedModel,
    LoopRecord,
    SpectrumRecord,
)
from lbt_synth.report.figures.style import require_figure_name
from lbt_synth.storage.atomic_files import require_writable


def require_model_name(path: Path) -> Path:
    """Refuse a model whose ending is not that of YAML."""
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise OutputError(f"a model must end in .yaml or .yml; got {path.name!r}.", path=path)
    return path


def figure_path(arguments: Namespace, output: Path) -> Path | None:
    """Return where the figure goes: by default beside the output, or None for no figure."""
    if arguments.no_figure:
        if arguments.figure is not None:
            raise ProblemError("give one of --figure and --no-figure, not both.")
        return None
    return require_figure_name(
        output.with_suffix(".png") if arguments.figure is None else arguments.figure
    )


def require_places(arguments: Namespace, *outputs: Path | None) -> None:
    """Refuse outputs that cannot be written, replace an input, or each other."""
    places = [place for place in outputs if place is not None]
    if len({place.resolve() for place in places}) < len(places):
        raise OutputError(f"each output needs a name of its own; got {places[0]} twice.")
    given = (arguments.file, arguments.commands, arguments.lines_file, arguments.accelerometers)
    require_writable(*places, inputs=[name for name in given if name is not None])


def model_text(
    model: IdentifiedModel, arguments: Namespace, record: LoopRecord | SpectrumRecord
) -> bytes:
    """Return the text of a configuration for an identified model."""
    obstruction = record.obstruction if isinstance(record, LoopRecord) else arguments.obstruction
    if obstruction is not None and record.diameter_m is None:
        raise ProblemError("--obstruction is a fraction of the diameter; give --diameter-m.")
    source = ascii(Path(arguments.file).name)[1:-1]
    settings, comments = identified_config(
        model,
        diameter_m=record.diameter_m,
        obstruction=obstruction,
        wavelength_um=arguments.wavelength_um,
        title=f"Identified from {source} by lbt-synth {arguments.command}.",
    )
    return config_text(settings, comments).encode()

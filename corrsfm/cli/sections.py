"""Help in sections: what people use first, then the options of each stage under a heading of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import click

__all__ = ["GENERAL", "MOST_USED", "SectionedCommand", "SectionedOption", "section_of"]

MOST_USED = "Most used"
GENERAL = "General"

# As wide as click lets the column of flags become.
_COLUMN_WIDTH = 30


def section_of(config: type) -> str:
    """The heading over the options of a config dataclass: its table in a file, and its docstring.

    ``FeaturesConfig`` with the docstring "SIFT extraction." gives "features – SIFT extraction".
    """
    text = (config.__doc__ or "").strip().splitlines()[0].rstrip(".")
    if not text[:2].isupper():
        text = text[:1].lower() + text[1:]
    return f"{config.__name__.removesuffix('Config').lower()} – {text}"


class SectionedOption(click.Option):
    """An option that knows the heading it is listed under."""

    def __init__(self, *args: Any, section: str, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.section = section

    def get_help_extra(self, ctx: click.Context) -> Any:
        """As click has it, but "default: off" instead of "default: no-such-option"."""
        extra = super().get_help_extra(ctx)
        if self.is_bool_flag and "default" in extra:
            extra["default"] = "on" if self.default else "off"
        return extra


class SectionedCommand(click.Command):
    """A command whose help lists its options in sections, each option once.

    Parameters
    ----------
    most_used : sequence of str
        Names of the parameters listed first, in this order.
    """

    def __init__(self, *args: Any, most_used: Sequence[str] = (), **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.most_used = tuple(most_used)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options: most used first, then section by section, then those of no section."""
        options = {option.name: option for option in self.get_params(ctx) if isinstance(option, click.Option)}
        sections: dict[str, list[tuple[str, str]]] = {MOST_USED: []}
        general = []
        for name in dict.fromkeys([*self.most_used, *options]):
            option = options[name]
            record = option.get_help_record(ctx)
            if record is None:  # hidden
                continue
            if name in self.most_used:
                sections[MOST_USED].append(record)
            elif isinstance(option, SectionedOption):
                sections.setdefault(option.section, []).append(record)
            else:
                general.append(record)
        for heading, records in (*sections.items(), (GENERAL, general)):
            if records:
                with formatter.section(heading):
                    # One column of flags through all sections.
                    formatter.write_dl([(flags.ljust(_COLUMN_WIDTH), text) for flags, text in records])

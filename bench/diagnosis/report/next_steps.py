"""Report section on next steps: experiment, reliable numbers, model-file changes and commands."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from html import escape
from pathlib import Path

from bench.diagnosis.report.consistency_section import format_consistency
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.summary_text import format_coefficients, format_next_run
from bench.diagnosis.report.wording import format_effect, format_sentence, sanitise
from bench.pages.html_elements import (
    make_code,
    make_collapsible,
    make_list,
    make_paragraph,
    make_strong,
    safe,
)

MAX_OPEN_CHANGES = 12
"""Maximum number of changes of a model file that are shown unfolded."""
_OTHER, _LOGS = "OTHER.csv", "LOGS.csv"
"""Placeholders that a reader replaces."""


def render_next_steps(story: DiagnosisReportData, folder: Path | None) -> Iterator[str]:
    """Yield the parts of the section, in the order in which a user would act.

    Args:
        story: Report data.
        folder: Folder of the written explanation; None in a notebook.
    """
    if story.verdict.recording_faults:
        yield from _corrections(story)
        return
    yield from _experiment(story)
    yield from _numbers(story)
    yield from render_model_file_changes(story)
    yield from _models(story, folder)
    yield from _further(story)


def _corrections(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the lines that correct a wrong unit or sign, and the command to repeat."""
    file = story.path.with_suffix(".toml").name
    for fault in story.verdict.recording_faults:
        yield make_paragraph(safe(format_sentence(fault.says), 1000))
        if fault.lines:
            yield make_paragraph(f"In {safe(file, 200)}:")
            yield make_list(make_code(safe(line, 200)) for line in fault.lines)
    yield make_paragraph("Then explain the recording again:")
    yield render_command("simgap", "explain", _recording(story))


def _experiment(story: DiagnosisReportData) -> Iterator[str]:
    proposed = format_next_run(story)
    if proposed:
        yield make_paragraph(f"{make_strong('Next experiment:')} {safe(proposed, 1000)}")
    if proposed or story.verdict.verdict == "ambiguous":
        yield make_paragraph(
            "Commands that would settle it, planned for this system, and both logs explained:"
        )
        yield render_command("simgap", "design", _recording(story), "--out", "next.csv")
        yield render_command("simgap", "explain", _recording(story), "next.csv")


def _numbers(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the numbers of the causes with intervals, and their consistency between runs."""
    if not story.verdict.causes:
        return
    found = [
        f"{safe(format_sentence(format_effect(cause.effect))[:-1], 200)}: "
        f"{safe(format_coefficients(cause), 1000)}"
        for cause in story.verdict.causes
    ]
    trust = [safe(text, 1000) for text in format_consistency(story)]
    yield make_paragraph(make_strong("Which numbers to trust (95 % intervals):"))
    yield make_list([*found, *trust])


def render_model_file_changes(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the lines of the robot's model file to change, before and after."""
    # Notes on an unchanged file are not useful.
    if not story.changes and not (story.unwritable_causes and story.verdict.causes):
        return
    head = make_strong("What to change in the model file") + " (extended.xml has it done):"
    lines = []
    for change in story.changes:
        lines.append(f'<span class="soft">{safe(change.element, 120)}</span>')
        # A blank line separates elements, and there is none within an element.
        lines += [f'<del class="line">− {safe(change.before, 2000)}</del>'] * bool(change.before)
        lines += [f'<ins class="line">+ {safe(change.after, 2000)}</ins>'] * bool(change.after)
        lines += [f'<span class="soft">  {safe(change.comment, 600)}</span>'] * bool(change.comment)
        lines.append("")
    if lines:
        text = f'<pre class="changes" tabindex="0">{chr(10).join(lines[:-1])}</pre>'
        many = len(story.changes) > MAX_OPEN_CHANGES
        yield make_paragraph(head)
        yield make_collapsible(f"All {len(story.changes)} changes", text) if many else text
    if story.unwritable_causes:
        yield make_paragraph(
            "What is to be known of it, and what it cannot say (extended.toml has all):"
        )
        yield make_list(safe(format_sentence(text)) for text in story.unwritable_causes)


def _models(story: DiagnosisReportData, folder: Path | None) -> Iterator[str]:
    """Yield the command that scores the extended simulator on another recording."""
    if folder is None:
        return
    model = folder / "extended.toml"
    extended = bool(story.verdict.causes)
    what = "the extended simulator" if extended else "the simulator with what was tuned"
    yield make_paragraph(f"How far {what} errs on another recording:")
    yield render_command("simgap", "score", model, _OTHER)


def _further(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the next steps that depend on the verdict."""
    verdict = story.verdict.verdict
    if verdict == "adequate":
        yield make_paragraph(
            "Nothing has to be changed. A recording that would narrow the numbers further is "
            "planned by"
        )
        yield render_command("simgap", "design", _recording(story), "--out", "next.csv")
    elif story.verdict.cut is not None:
        yield make_paragraph("The search was ended early; to the end it goes with")
        yield render_command("simgap", "explain", _recording(story))
    elif verdict in ("partial", "unknown"):
        if verdict == "partial" and story.held_out is not None and not story.thorough:
            yield make_paragraph(
                "To have the library searched further for what remains, judged by the "
                f"{story.validation_runs} (about twice as long):"
            )
            yield render_command("simgap", "explain", _recording(story), "--thorough")
        yield make_paragraph(
            "If you have an idea what remains, write it as an effect of your own (simgap's "
            "docs/extending.md) and have it tried with the others:"
        )
        yield render_command("simgap", "explain", _recording(story), "--plugin", "my_effect.py")
    elif verdict == "unidentifiable":
        yield make_paragraph("Which numbers a recording can fix, asked before any fit:")
        yield render_command("simgap", "inspect", _recording(story), "--check")


def _recording(story: DiagnosisReportData) -> str:
    """Return the recording's path; for several logs a placeholder."""
    return str(story.path) if story.logs == 1 else _LOGS


def render_command(*words: object) -> str:
    """Render a command that can be copied, with its words quoted for a shell."""
    # Line breaks and escape sequences in a path must not reach a terminal unchanged.
    texts = [shlex.quote(sanitise(word, 500)) for word in words]
    return f'<pre class="copied" tabindex="0">{escape(" ".join(texts))}</pre>'

"""Pages of the site that are made from other files: commands from their help, examples, benchmarks, changes."""

from __future__ import annotations

import re
from os.path import relpath
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
PAGES = Path(__file__).parent / "pages"
LINK = re.compile(r"\[([^\]]*)\]\(([^)#:]+)(#[^)]*)?\)")
ROLE = re.compile(r":(?:class|func|meth|mod|attr|data|exc):<code>~?([^<]*)</code>")
"""Cross references of docstrings, in HTML."""


def on_files(files: Files, config: Any) -> Files:
    """Add the pages, and the figures of benchmarks."""
    benchmarks = (ROOT / "benchmarks/README.md").read_text(encoding="utf-8")
    for name, text in {**examples(), "reference/commands.md": commands(), "benchmarks.md": benchmarks}.items():
        files.append(File.generated(config, name, content=text))
    for figure in sorted((ROOT / "benchmarks/figures").glob("*.png")):
        files.append(File.generated(config, f"benchmarks/figures/{figure.name}", abs_src_path=str(figure)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links to files of the repository, which work where it is shown, to the pages of the site."""
    here = PAGES / page.file.src_uri
    source = ROOT / "benchmarks/README.md" if page.file.src_uri == "benchmarks.md" else here

    def led(found: re.Match[str]) -> str:
        target = (source.parent / found[2]).resolve()
        if not target.is_file():
            return found[0]
        place = place_of(target.relative_to(ROOT).as_posix())
        if place is None:
            return f"`{found[1].strip('`')}`"
        return f"[{found[1]}]({relpath(PAGES / place, here.parent)}{found[3] or ''})"

    return LINK.sub(led, markdown)


def place_of(name: str) -> str | None:
    """Where the site has a file of the repository; None if it has not."""
    if name == "benchmarks/README.md":
        return "benchmarks.md"
    if name.startswith("benchmarks/figures/"):
        return name
    if name.startswith("scripts/examples/"):
        return f"examples/{Path(name).stem}.md"
    return name.removeprefix("scripts/docs/pages/") if name.startswith("scripts/docs/pages/") else None


def on_page_content(html: str, **_: Any) -> str:
    """Show the targets of cross references in docstrings as code."""
    return ROLE.sub(lambda found: f"<code>{found[1].rpartition('.')[2] or found[1]}</code>", html)


def on_post_page(output: str, **_: Any) -> str:
    """Name the theme's search dialog, for readers who hear the page."""
    return output.replace('role="dialog"', 'role="dialog" aria-label="Search"')


def examples() -> dict[str, str]:
    """A page of each guide that runs."""
    return {
        f"examples/{path.stem}.md": f"# {path.name}\n\n    python scripts/examples/{path.name}\n\n"
        f"```python\n{path.read_text(encoding='utf-8')}```\n"
        for path in sorted((ROOT / "scripts/examples").glob("*.py"))
    }


def commands() -> str:
    """Help of all commands."""
    from typer import Context  # noqa: PLC0415  # with the package, which other pages do not need
    from typer.main import get_command  # noqa: PLC0415

    from diffeo_calib.cli.main import app  # noqa: PLC0415

    whole: Any = get_command(app)
    text = ["# Commands\n"]
    for name, command in whole.commands.items():
        context = Context(command, info_name=name)
        records = [one.get_help_record(context) for one in command.params]
        rows = [f"| `{cleaned(option, code=False)}` | {cleaned(words)} |" for option, words in filter(None, records)]
        head = [f"## {name}\n", cleaned(command.help), "", "| option | meaning |", "|---|---|"]
        text.append("\n".join([*head, *rows]))
    return "\n\n".join(text) + "\n"


def cleaned(text: str | None, *, code: bool = True) -> str:
    """A text for a table of Markdown, options in it as code."""
    line = " ".join((text or "").replace("|", "\\|").split())
    return re.sub(r"(?<![`\w])(--[a-z][\w-]*)", r"`\1`", line) if code else line

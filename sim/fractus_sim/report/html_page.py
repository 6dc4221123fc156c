"""Report as one HTML file that contains its figures and pictures, so that it can be sent and archived."""

from __future__ import annotations

import base64
import html
import mimetypes
import re
from collections.abc import Sequence
from pathlib import Path
from string import Template

from markdown_it import MarkdownIt

HTML_PAGE = "report.html"

_TEMPLATE = Template("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>$title</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem; color: #1f2328; }
table { border-collapse: collapse; display: block; overflow-x: auto; margin: 1rem 0; }
th, td { border: 1px solid #d0d7de; padding: .3rem .6rem; text-align: left; vertical-align: top; }
th { background: #f6f8fa; }
img { max-width: 100%; }
</style>
</head>
<body>
$summary
$figures
$sections
</body>
</html>
""")
_IMAGE = re.compile(r'(?<= src=")[^"]+(?=")')


def html_page(
    title: str, *, summary: str, figures: Sequence[str], sections: str, pictures: Sequence[str], folder: Path
) -> str:
    """Return a report as an HTML page that needs no other file.

    Args:
        title: Title of the page.
        summary: Markdown above the figures.
        figures: Names of the image files of the figures.
        sections: Markdown below the figures.
        pictures: Names of the image files that the sections show.
        folder: Folder of the image files.
    """
    # Components determine some texts, such as arguments of calls. HTML in such texts is escaped, and an image that such a text
    # names is not embedded, because it could be any file of the user.
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table")
    known = {*figures, *pictures}

    def embed(match: re.Match[str]) -> str:
        name = match.group()
        return _data_uri(folder / name) if name in known else name

    def embedded(text: str) -> str:
        return _IMAGE.sub(embed, text)

    drawn = "".join(f'<p><img src="{name}" alt="{Path(name).stem}"></p>\n' for name in figures)
    return _TEMPLATE.substitute(
        title=html.escape(title),
        summary=markdown.render(summary),
        figures=embedded(drawn),
        sections=embedded(markdown.render(sections)),
    )


def _data_uri(image: Path) -> str:
    kind, _ = mimetypes.guess_type(image.name)
    return f"data:{kind};base64,{base64.b64encode(image.read_bytes()).decode()}"

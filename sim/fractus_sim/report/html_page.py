"""Report as one HTML file that contains its figures and pictures, so that it can be sent and archived."""

from __future__ import annotations

import base64
import html
import mimetypes
from collections.abc import Mapping, Sequence
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
$pictures
</body>
</html>
""")


def html_page(
    title: str, *, summary: str, figures: Sequence[str], sections: str, pictures: Mapping[str, str], folder: Path
) -> str:
    """Return a report as an HTML page that needs no other file.

    Args:
        title: Title of the page.
        summary: Markdown above the figures.
        figures: Names of the image files of the figures.
        sections: Markdown below the figures.
        pictures: Titles of the camera pictures at the end of the page, by the name of the image file.
        folder: Folder of the image files.
    """
    # Components determine some texts, such as arguments of calls. HTML in such texts is escaped, and images and links that they
    # contain remain text, because they could embed any file of the user, or a large picture many times.
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table").disable(["image", "link", "autolink"])
    drawn = [_image(folder / name, Path(name).stem) for name in figures]
    shown = [
        f"<p>{html.escape(text)}</p>\n{_image(folder / name, 'from the drone')}" for name, text in pictures.items()
    ]
    return _TEMPLATE.substitute(
        title=html.escape(title),
        summary=markdown.render(summary),
        figures="".join(drawn),
        sections=markdown.render(sections),
        pictures="".join(["<h2>Camera pictures</h2>\n", *shown] if shown else []),
    )


def _image(file: Path, description: str) -> str:
    kind, _ = mimetypes.guess_type(file.name)
    data = base64.b64encode(file.read_bytes()).decode()
    return f'<p><img src="data:{kind};base64,{data}" alt="{description}"></p>\n'

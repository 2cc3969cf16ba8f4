"""Formulas as MathML, which browsers draw by themselves: no script, no font, no network, no LaTeX."""

from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator


def inline(translator: HTML5Translator, node: nodes.math) -> None:
    """
    :param translator: Writes the page
    :param node: A formula within a line
    """
    translator.body.append(latex2mathml.tex2mathml(node.astext()))
    raise nodes.SkipNode


def block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """
    :param translator: Writes the page
    :param node: A formula of its own
    """
    translator.body.append(f'<div class="math">{latex2mathml.tex2mathml(node.astext().strip(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """
    :param app: That builds the site
    :return: What Sphinx asks of an extension
    """
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}

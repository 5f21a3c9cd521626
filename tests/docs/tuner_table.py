"""Build the page on tuners from module docstrings with typeset equations, and from their options.

A docstring has an equation as plain text. `SET` maps this text to LaTeX, so a changed equation
needs a new entry.
"""

import dataclasses
import importlib
import inspect
import re

from tests.docs.documentation_pages import ROOT

SET = {
    "e_i = P(e_j, a_j, s_j, r_j for j = i - k ... i - 1)": (
        r"e_i = P\left(e_j, a_j, s_j, r_j \text{ for } j = i - k, \ldots, i - 1\right)"
    ),
    "q'' = k0 + k1 q + k3 q^3 + kf sign(q') + ku u + kd q'": (
        r"\ddot q = k_0 + k_1 q + k_3 q^3 + k_f \operatorname{sign}(\dot q) + k_u u + k_d \dot q"
    ),
    "integral of w q'' = integral of w'' q, integral of w q' = -integral of w' q": (
        r"\int w \ddot q = \int \ddot w q, \quad \int w \dot q = -\int \dot w q"
    ),
    "w(s) = (1 - s^2)^4, s from -1 to 1 over the bump": (
        r"w(s) = (1 - s^2)^4, \quad s \text{ from } -1 \text{ to } 1 \text{ over the bump}"
    ),
    "zeta_k = zeta_{k-1} + h(o_P, o_T)": r"\zeta_k = \zeta_{k-1} + h(o_P, o_T)",
    "s = -B^-1 h, at first B = -1, which is a step of TuneNet's Algorithm 1": (
        r"s = -B^{-1} h, \quad \text{at first } B = -1,"
        r" \text{ which is a step of TuneNet's Algorithm 1}"
    ),
    "B <- B + (y - B s) s^T / (s^T s)": r"B \leftarrow B + \frac{(y - B s)\, s^T}{s^T s}",
    "EI = (f - m) Phi((f - m) / s) + s phi((f - m) / s)": (
        r"\mathrm{EI} = (f - m)\, \Phi\left(\frac{f - m}{s}\right)"
        r" + s\, \varphi\left(\frac{f - m}{s}\right)"
    ),
    "-P(θ) log P(θ)": r"-P(\theta) \log P(\theta)",
    "J s = y for each, by least squares": r"J s = y \quad \text{for each, by least squares}",
    "(J^T J + mu D) s = -J^T r Marquardt's step": (
        r"(J^T J + \mu D)\, s = -J^T r \quad \text{Marquardt's step}"
    ),
    "gain = decrease of r^T r / the decrease promised by r + J s": (
        r"\mathrm{gain} = \frac{\text{decrease of } r^T r}"
        r"{\text{decrease promised by } r + J s}"
    ),
    "mu <- mu max(1/3, 1 - (2 gain - 1)^3) where gain > 0, else mu <- mu nu, nu <- 2 nu": (
        r"\mu \leftarrow \mu \max\left(\tfrac{1}{3}, 1 - (2\, \mathrm{gain} - 1)^3\right)"
        r" \text{ where gain} > 0, \text{ else } \mu \leftarrow \mu \nu, \nu \leftarrow 2 \nu"
    ),
    "J <- J + (r(θ + s) - r - J s) s^T / (s^T s) Broyden's update": (
        r"J \leftarrow J + \frac{\left(r(\theta + s) - r - J s\right) s^T}{s^T s}"
        r" \quad \text{Broyden's update}"
    ),
    "the minimum over w of the mean of -log q_w(θ | o)": (
        r"\min_w \; \mathrm{mean}\left(-\log q_w(\theta \mid o)\right)"
    ),
    "length * l_i / (l_1 l_2 ... l_d)^(1/d)": (
        r"\mathrm{length} \cdot \frac{l_i}{(l_1 l_2 \cdots l_d)^{1/d}}"
    ),
    "n(a, b) = Wo u(Wj [u(Wp a), u(Wt b)]), each W with its bias; published: tanh of it": (
        r"n(a, b) = W_o\, u\left(W_j \left[u(W_p a), u(W_t b)\right]\right),"
        r" \quad \text{each } W \text{ with its bias; published: tanh of it}"
    ),
    "h(a, b) = (n(a, b) - n(b, a)) / 2, so that h(o, o) = 0; published: h = n": (
        r"h(a, b) = \frac{n(a, b) - n(b, a)}{2}, \quad \text{so that } h(o, o) = 0;"
        r" \text{ published: } h = n"
    ),
    "loss = mean |h - difference|^2 / (|difference|^2 + relative^2) + lambda |weights|^2": (
        r"\mathrm{loss} = \mathrm{mean}\, \frac{|h - \mathrm{difference}|^2}"
        r"{|\mathrm{difference}|^2 + \mathrm{relative}^2} + \lambda\, |\mathrm{weights}|^2"
    ),
    "x - mean = d slopes + residual, by least squares in each scenario": (
        r"x - \mathrm{mean} = d \cdot \mathrm{slopes} + \mathrm{residual},"
        r" \quad \text{by least squares in each scenario}"
    ),
    "reliability of a parameter = e / (e + s * residual), e = |slope| * spread of the parameter": (
        r"\text{reliability of a parameter} = \frac{e}{e + s \cdot \mathrm{residual}},"
        r" \quad e = |\mathrm{slope}| \cdot \text{spread of the parameter}"
    ),
    "weight = (largest reliability, scaled to the same maximum for each parameter)^2, per "
    "deviation": (
        r"\mathrm{weight} = (\text{largest reliability, scaled to the same maximum"
        r" for each parameter})^2 \text{ per deviation}"
    ),
    "weight for the scenario = (b / (b + s * w))^2, per deviation, with b and w the standard "
    "deviations between and within scenarios": (
        r"\text{weight for the scenario} = \left(\frac{b}{b + s w}\right)^2 \text{ per deviation},"
        r" \; b, w \text{ the standard deviations between and within scenarios}"
    ),
    "y = (a + b x) / (1 + c x)": r"y = \frac{a + b x}{1 + c x}",
    "y = a + b x - c x y": r"y = a + b x - c x y",
    "posterior mean = m + k* K^-1 (y - m)": (r"\text{posterior mean} = m + k_* K^{-1} (y - m)"),
    "posterior covariance = variance (k** - k* K^-1 k*^T)": (
        r"\text{posterior covariance} = \mathrm{variance} \left(k_{**} - k_* K^{-1} k_*^T\right)"
    ),
    "log likelihood = -(y - m)^T K^-1 (y - m) / (2 variance) - log |K| / 2 - ...": (
        r"\text{log likelihood} = -\frac{(y - m)^T K^{-1} (y - m)}{2\, \mathrm{variance}}"
        r" - \frac{\log |K|}{2} - \dots"
    ),
}
"""LaTeX of each equation, by its text in a docstring."""
EQUATION = re.compile(r"\(([\d.]+)\)  (.*)", re.S)
SHARED = (
    "pair_network",
    "broyden_search",
    "input_features",
    "gap_filling",
    "gaussian_process",
)
"""Modules below methods/learning that several tuners share."""
LINKS = {
    r"\barXiv[: ](\d{4}\.\d{5})": r"[arXiv:\1](https://arxiv.org/abs/\1)",
    r"\bdoi:(10\.[^\s,;]+[^\s,;.:)])": r"[doi:\1](https://doi.org/\1)",
}
"""Patterns of article identifiers, and their links."""
REFERENCE_TUNER = "tunenet"
"""Tuner whose options other learned tuners share."""
AS_IN_REFERENCE = "as in `methods.tuners.tunenet.TuneNet`."
"""Text of an option that is described there only."""


def registered():
    """Return the project's tuners as (name, module, class) in the order of pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    group = text.partition('[project.entry-points."simgap.tuners"]\n')[2].partition("\n\n")[0]
    found = re.findall(r"^([\w-]+) = \"([\w.]+):(\w+)\"$", group, re.M)
    return [(name, importlib.import_module(module), kind) for name, module, kind in found]


def sections():
    """Return a Markdown section for each tuner module and for the shared modules."""
    by_module = {}
    for name, module, kind in registered():
        by_module.setdefault(module, []).append((name, getattr(module, kind)))
    reference = next(kind for [(name, kind), *_] in by_module.values() if name == REFERENCE_TUNER)
    shared = describe_options(reference)
    parts = []
    for module, tuners in by_module.items():
        parts.append("## " + ", ".join(f"`{name}`" for name, _ in tuners))
        if len(tuners) == 1:
            parts += describe_tuner(*tuners[0], module, shared)
            continue
        parts += describe_module(module)
        for name, kind in tuners:
            parts += [f"### `{name}`", *split_docstring(kind), *options_of(name, kind, shared)]
    parts += ["## What learned tuners and searches share"]
    for name in SHARED:
        module = importlib.import_module(f"methods.learning.{name}")
        parts += [f"### `methods.learning.{name}`", *describe_module(module)]
    return parts


def describe_tuner(name, kind, module, shared):
    """Return the docstrings of a tuner and of its module, and the options.

    The module has no other tuner, so its summary says the same as that of the tuner.
    """
    summary, *rest = split_docstring(kind)
    _, *background = paragraphs(inspect.cleandoc(module.__doc__))
    head = f"{summary} {link_to(module)}"
    return [head, *background, *rest, *options_of(name, kind, shared)]


def describe_module(module):
    """Return a module's docstring as paragraphs and typeset equations, and a link to its file."""
    summary, *rest = paragraphs(inspect.cleandoc(module.__doc__))
    return [f"{summary} {link_to(module)}", *rest]


def link_to(module):
    """Return a link to the file of a module."""
    file = "/".join(module.__name__.split(".")) + ".py"
    return f"[`{file}`](../../{file})."


def paragraphs(text):
    """Yield the paragraphs of a docstring as Markdown, with indented equations as formulas."""
    for block in text.split("\n\n"):
        if not block.startswith("    "):
            yield linked(" ".join(block.split()).replace("``", "`"))
            continue
        for line in re.split(r"\n(?=    \()", block):
            number, words = EQUATION.fullmatch(line.strip()).groups()
            yield f"```math\n{SET[' '.join(words.split())]} \\qquad ({number})\n```"


def linked(text):
    """Replace article identifiers by links."""
    for pattern, link in LINKS.items():
        text = re.sub(pattern, link, text)
    return text


def split_docstring(kind):
    """Return the paragraphs of a class's docstring, without those of its attributes."""
    return [*paragraphs(inspect.getdoc(kind).partition("Attributes:\n")[0].strip())]


def describe_options(kind):
    """Return the description of each option of a tuner, in the order of the fields."""
    options = inspect.getdoc(kind).partition("Attributes:\n")[2]
    says = dict(re.findall(r"^    (\w+): ((?:.|\n        )*)", options, re.M))
    names = [field.name for field in dataclasses.fields(kind) if field.name in says]
    return {name: " ".join(says[name].split()) for name in names}


def options_of(name, kind, shared):
    """Return a list of a tuner's options with their defaults, and a line of those it shares."""
    fields = {field.name: field for field in dataclasses.fields(kind)}
    rows, elsewhere = [], []
    for option, says in describe_options(kind).items():
        assigned = f"`{option}={default(fields[option])}`"
        reference = shared.get(option, "")
        # The reference may add a clause to the description.
        alike = {AS_IN_REFERENCE, reference, reference.partition(";")[0] + "."}
        if name != REFERENCE_TUNER and says in alike:
            elsewhere.append(assigned)
        else:
            rows.append(f"- {assigned}: {says.removesuffix('.')}")
    parts = ["\n".join(rows)] if rows else []
    if elsewhere:
        link = f"[`{REFERENCE_TUNER}`](#{REFERENCE_TUNER})"
        parts.append(f"Options as for {link}: {', '.join(elsewhere)}.")
    return parts


def default(field):
    """Format an option's default."""
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    return f"{value:g}" if isinstance(value, float) else repr(value)

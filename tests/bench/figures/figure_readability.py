"""Check that all texts of a figure are readable."""


def unreadable(figure):
    """Return the texts of a figure that are shortened, outside it, or overlap another text.

    Args:
        figure: a Matplotlib figure with its final layout.
    """
    from matplotlib.text import Text

    figure.draw_without_rendering()
    renderer = figure._get_renderer()
    page = figure.bbox
    shown = []
    for text in _texts(figure):
        if text.get_visible() and text.get_text().strip():
            # For an annotation, measure the text without its arrow.
            shown.append((text.get_text(), Text.get_window_extent(text, renderer)))
    faults = [f"shortened: {words}" for words, _ in shown if "…" in words]
    for words, box in shown:
        # Antialiasing may exceed the figure by one pixel.
        inside = (
            box.x0 > -1 and box.y0 > -1 and box.x1 < page.width + 1 and box.y1 < page.height + 1
        )
        if not inside:
            faults.append(f"outside: {words}")
    for i, (words, box) in enumerate(shown):
        for other, other_box in shown[i + 1 :]:
            width = min(box.x1, other_box.x1) - max(box.x0, other_box.x0)
            height = min(box.y1, other_box.y1) - max(box.y0, other_box.y0)
            # Boxes include space for descenders, so adjacent lines touch.
            if width > 2 and height > 4:
                faults.append(f"overlapping: {words} / {other}")
    return faults


def _texts(figure):
    """Yield the drawn texts; tick labels only within the limits of their axis."""
    from matplotlib.text import Text

    yield from figure.texts
    for legend in figure.legends:
        yield from legend.findobj(Text)
    for axes in figure.axes:
        yield from axes.texts
        if not axes.axison:
            continue
        yield from (axes.title, axes._left_title, axes._right_title)
        if axes.get_legend():
            yield from axes.get_legend().findobj(Text)
        for axis in (axes.xaxis, axes.yaxis):
            yield from (axis.label, axis.offsetText)
            low, high = sorted(axis.get_view_interval())
            for tick in axis._update_ticks():
                if low <= tick.get_loc() <= high:
                    yield from (tick.label1, tick.label2)

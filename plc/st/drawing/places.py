"""The places of the elements of a Ladder Diagram or Function Block Diagram.

With positions of the file, the whole drawing is stretched until the texts have enough room, so that an engineer recognises it.
Without them, each network is arranged from left to right in the direction of the data, and networks below each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise

from fieldtwin.plc.st.drawing.canvas import CHAR
from fieldtwin.plc.st.drawing.figures import PIN, RAILS, SYMBOLS, VARIABLE_H, Figure
from fieldtwin.plc.st.plcopen.nodes import connected

MOST_STRETCHED = 3.0
"""The largest factor by which a drawing with positions is stretched. Longer texts are shortened."""
_ROOM = 10.0
"""The least distance between two texts, in px."""
_COLUMN = 44.0
"""The distance between two columns without positions, in px."""
_ROW = 30.0
_NETWORK = 46.0
"""The distance between two networks without positions, in px."""
_SOURCES = ("inVariable", "continuation")


def networks_of(figures: Mapping[str, Figure]) -> list[list[Figure]]:
    """Return the groups of connected elements from top to bottom, without power rails and comments. A label is in the group to
    which it leads.
    """
    ids = [n for n, one in figures.items() if one.tag not in (*RAILS, "comment", "label")]
    links = ((one.id, link.source) for one in figures.values() for port in one.inputs for link in port.links)
    found = [[figures[n] for n in network] for network in connected(ids, links)]
    order = list(figures)

    def place_of(one: Figure) -> tuple[float, float, int]:
        return one.y, one.x, order.index(one.id)

    found.sort(key=lambda network: min(map(place_of, network)))
    for label in (one for one in figures.values() if one.tag == "label"):
        following = (network for network in found if max(map(place_of, network)) > place_of(label))
        network = next(following, None)
        if network is None:
            found.append([label])
        else:
            network.append(label)
    for network in found:
        network.sort(key=lambda one: order.index(one.id))
    return sorted(found, key=lambda network: min(map(place_of, network)))


def place(figures: Mapping[str, Figure]) -> None:
    """Give every element its place and size."""
    with_place = {(one.x, one.y) for one in figures.values() if one.placed}
    if len(with_place) == len(figures):
        _stretch(list(figures.values()))
    else:
        _arrange(figures)


# -- positions of the file ------------------------------------------------------------------------------------------------


def _stretch(figures: Sequence[Figure]) -> None:
    for one in figures:
        one.width = one.width or one.needed_width
        one.height = one.height or one.needed_height
        _place_ports(one)
    across = [one.needed_width / one.width for one in figures if one.tag not in RAILS and one.tag != "comment"]
    across += [*_between_texts(figures), *_beside_rails(figures)]
    down = [VARIABLE_H / one.height for one in figures if one.tag not in RAILS]
    down += [
        (PIN - 2) / (b.y - a.y)
        for one in figures if one.tag == "block"
        for ports in (one.inputs, one.outputs)
        for a, b in pairwise(ports) if b.y > a.y
    ]  # fmt: skip
    kx, ky = (min(MOST_STRETCHED, max([1.0, *factors])) for factors in (across, down))
    for one in figures:
        one.x, one.y, one.width, one.height = one.x * kx, one.y * ky, one.width * kx, one.height * ky
        for port in one.ports:
            port.x, port.y = port.x * kx, port.y * ky
            for link in port.links:
                link.route = [(x * kx, y * ky) for x, y in link.route]
    _lengthen_rails(figures)


def _lengthen_rails(figures: Sequence[Figure]) -> None:
    """Make the left power rails reach the inputs that are connected to them, if the file does not give them this length."""
    rails = {one.id: one for one in figures if one.tag == "leftPowerRail"}
    for one in figures:
        for port in one.inputs:
            for link in port.links:
                rail, y = rails.get(link.source), one.y + port.y
                if rail is not None and not link.route:
                    low, high = min(rail.y, y - 10), max(rail.y + rail.height, y + 10)
                    for output in rail.outputs:
                        output.y += rail.y - low
                    rail.y, rail.height = low, high - low


def _between_texts(figures: Sequence[Figure]) -> Iterable[float]:
    """Yield the factors that separate the texts over symbols and blocks from their neighbours."""
    with_text = sorted((one for one in figures if one.above), key=lambda one: one.x)
    for number, one in enumerate(with_text):
        for other in with_text[number + 1 :]:
            if abs(one.y - other.y) < 16:
                needed = (len(one.above) + len(other.above)) * CHAR / 2 + _ROOM
                apart = other.x + other.width / 2 - one.x - one.width / 2
                if apart > 0:
                    yield needed / apart
                break


def _beside_rails(figures: Sequence[Figure]) -> Iterable[float]:
    """Yield the factors that separate the texts over symbols from the left power rail."""
    rails = [one.x + one.width for one in figures if one.tag == "leftPowerRail"]
    for one in figures if rails else ():
        apart = one.x + one.width / 2 - min(rails)
        if one.above and apart > 0:
            yield (len(one.above) * CHAR / 2 + 6) / apart


def _place_ports(one: Figure) -> None:
    """Give the ports without a position one at the left or right edge."""
    for ports, x in ((one.inputs, 0.0), (one.outputs, one.width)):
        for number, port in enumerate(ports):
            if not port.placed:
                step = (one.height - 20) / len(ports)
                port.x, port.y = x, 20 + step * (number + 0.5) if one.tag == "block" else one.height / 2


# -- without positions ----------------------------------------------------------------------------------------------------


def _arrange(figures: Mapping[str, Figure]) -> None:
    for one in figures.values():
        one.width, one.height = one.needed_width, one.needed_height
        for ports, x in ((one.inputs, 0.0), (one.outputs, one.width)):
            for number, port in enumerate(ports):
                port.x = x
                port.y = 34 + PIN * number if one.tag == "block" else one.height / 2
                for link in port.links:
                    link.route = []
    top = 0.0
    for comment in (one for one in figures.values() if one.tag == "comment"):
        comment.x, comment.y = 0.0, top
        top += comment.height + _ROW / 2
    right = 0.0
    networks = networks_of(figures)
    begin = top
    for network in networks:
        top, edge = _arrange_network(figures, network, top + 18)
        right = max(right, edge)
        top += _NETWORK - 18
    for one in figures.values():
        if one.tag in RAILS:
            one.x = 0.0 if one.tag == "leftPowerRail" else right + _COLUMN
            one.y, one.height = begin, max(VARIABLE_H, top - begin - _NETWORK + 30)


def _arrange_network(figures: Mapping[str, Figure], network: Sequence[Figure], top: float) -> tuple[float, float]:
    """Place the elements of one network below `top`. Return its lower and its right edge."""
    layers = _layers(figures, network)
    left, bottom, right = _COLUMN, top, 0.0
    rail = _COLUMN if any(one.tag == "leftPowerRail" for one in figures.values()) else 0.0
    for number, layer in enumerate(layers):
        fed = [_fed(figures, one) for one in layer]
        left += max((source.width + _ROW for sources in fed for source, _ in sources), default=0.0)
        if rail and not number:  # long texts over symbols need room
            left = max(left, *(len(one.above) * CHAR / 2 + _ROOM - one.width / 2 for one in layer))
        free = top if not number else -1e9
        for one, sources in zip(layer, fed, strict=True):
            one.x = left
            one.y = max(free + (20.0 if one.above else 0.0), _wanted(figures, one, top))
            for source, y in sources:
                source.x, source.y = left - _ROW - source.width, one.y + y - source.height / 2
            lower = [one.y + one.height, *(source.y + source.height for source, _ in sources)]
            free = max(lower) + (_ROW if one.height > VARIABLE_H else _ROOM)
            bottom = max(bottom, *lower)
        right = max(one.x + max(one.width, (one.width + len(one.above) * CHAR) / 2) for one in layer)
        left = right + _COLUMN
        following = layers[number + 1] if number + 1 < len(layers) else ()
        left = max([left, *(right + len(one.above) * CHAR / 2 + _ROOM - one.width / 2 for one in following)])
    higher = min(one.y - (20.0 if one.above else 0.0) for one in network)
    for one in network:
        one.y += top - higher
    return bottom + top - higher, right


def _fed(figures: Mapping[str, Figure], one: Figure) -> list[tuple[Figure, float]]:
    """Return the variables that are drawn directly before the inputs of an element, with the places of these inputs."""
    found = []
    for port in one.inputs:
        for link in port.links[:1]:
            source = figures.get(link.source)
            if source is not None and source.tag in _SOURCES and _first_reader(figures, source) is port:
                found.append((source, port.y))
    return found


def _first_reader(figures: Mapping[str, Figure], source: Figure) -> object:
    ports = (port for one in figures.values() for port in one.inputs)
    return next((port for port in ports if port.links and port.links[0].source == source.id), None)


def _wanted(figures: Mapping[str, Figure], one: Figure, otherwise: float) -> float:
    """Return the place at which the first connected input is level with its source; `otherwise` without such an input."""
    for port in one.inputs:
        for link in port.links:
            source = figures.get(link.source)
            if source is not None and source.tag not in (*RAILS, *_SOURCES) and source.x < one.x:
                output = source.output(link.pin)
                return source.y + (output.y if output is not None else source.height / 2) - port.y
    return otherwise


def _layers(figures: Mapping[str, Figure], network: Sequence[Figure]) -> list[list[Figure]]:
    """Return the elements by the number of elements before them. A connection that closes a loop does not count."""
    inside = {one.id for one in network}
    depth: dict[str, int] = {}
    state: dict[str, bool] = {}
    for start in network:
        stack = [(start, False)]
        while stack:
            one, done = stack.pop()
            sources = [link.source for port in one.inputs for link in port.links if link.source in inside]
            if done:
                depth[one.id] = 1 + max(
                    (depth[s] for s in sources if s in depth and figures[s].tag not in _SOURCES), default=-1
                )
                state[one.id] = True
            elif one.id not in state:
                state[one.id] = False
                stack.append((one, True))
                stack += [(figures[s], False) for s in sources if s not in state]
    found: list[list[Figure]] = [[] for _ in range(max(depth.values()) + 1)]
    for one in network:
        attached = one.tag in _SOURCES and _first_reader(figures, one) is not None
        if not attached:
            found[depth[one.id]].append(one)
    return [layer for layer in found if layer]


def room_for(one: Figure, figures: Iterable[Figure]) -> float:
    """Return the width that the text over an element may have, so that it does not reach a neighbour."""
    middle = one.x + one.width / 2
    room = 400.0
    for other in figures:
        if other is not one and other.tag not in RAILS and abs((other.y) - one.y) < 16 and other.above:
            share = (len(one.above) + 1) / (len(one.above) + len(other.above) + 1)
            room = min(room, 2 * share * abs(other.x + other.width / 2 - middle) - _ROOM)
    return max(room, one.width if one.tag not in SYMBOLS else 24.0)

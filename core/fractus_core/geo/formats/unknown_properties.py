"""Unknown properties of imported files: decide if a property may state the size, altitude or time of a zone.

Files of authorities and of mapping programs use any names and languages. Therefore a property is judged by its name and
by its value. In doubt, the answer is yes, because an import that omits a limit makes a zone too small or too large.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

EMPTY: tuple[Any, ...] = (None, "", [], {})
"""Values without content, which cannot state a limit."""

_WORD = re.compile(r"[^\W\d_]+")
_CAPITALS = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")

_LIMIT_WORD = re.compile(
    r"""(
    radius | radii | rad | diam | dia | dist | width | range | reach | size | ring | offset | circle | ellipse |
    km | kms | nm | nmi | hgt | hght | ht | lvl | lim | sup | inf | axis | spread | within | proximity | expand | outset | girth | meters? | metres? | miles? | units? | uom |
    alt | altitudes? | heights? | level | levels | floor | ceil | bottom | top | base | agl | [am]msl | asl | msl | fl | feet | ft | gnd | sfc |
    unl | elev | z | [hz]max | [hz]min |
    times? | dates? | starts? | begins? | ends? | from | to | until | till | since | active |
    hours? | hrs | days? | months? | years? | expires | effective | temporary | permanent | when |
    night | nighttime | daytime | daylight | sunrise | sunset | dusk | dawn | h24 | hj | hn |
    rayon | radio | raggio | raio | straal | umkreis | abstand | puffer | tampon | hoch | tief | oben | unten |
    plafond | plancher | altura | altezza | quota | techo | hoogte | zeit | datum | von | bis | ab | heure | debut | début | fin | ende |
    fecha | hora | inizio | jours? | dias | tag | tage | sol | toit | ober | unter | open | opens | close | closes | window | ttl |
    cron | rrule | notam | inforce | tstart | tend
    )""",
    re.VERBOSE,
)
"""Whole words in the name of a property that may state a limit.

Short words are matched whole because longer words contain them by accident.
"""

_LIMIT_STEM = re.compile(
    r"""
    radius | diamet | buffer | distan | clearance | extent | corridor | perimet | margin |
    altitud | height | elevat | ceiling | upper | lower | limit | vertical | flightlevel | ^max | max$ | ^min(?!is|ing|or) | (?<!ad)min$ |
    breite | länge | laenge | largeur | ancho | afstand | promie | радиус | висот | высот | wysoko | halfwidth | safety | protect |
    inflate | dilate | grow | semi(?:major|minor) | apothem | circumf | footprint | keepout | standoff | separation | setback |
    exclusion | grenze | puffer |
    h[oöø]he | hoehe | hauteur | altezz |
    timespan | timestamp | timefrom | timeto | datetime | startdate | enddate | starttime | endtime | datefrom | dateto | dateend |
    datestart | valid | activ | applicab | period | weekday | season | expir | duration | schedul | gültig | gueltig | horaire | horario | orari | vigen | beginn | anfang | zeitraum | recurren | timeframe | inforce
    """,
    re.VERBOSE,
)
"""Parts of words in the name of a property that may state a limit.

Many programs write names without a separator (`maxalt`, `bufferzone`, `validfrom`).
"""

_HARMLESS_NAMES = frozenset(
    {
        "id", "ids", "fid", "gid", "oid", "uid", "uuid", "guid", "globalid", "objectid", "ogcfid", "featureid", "identifier", "code", "icao", "iata",
        "number", "nr", "no", "ref", "index", "idx", "order", "draworder", "zindex", "priority", "version", "revision",
        "shapearea", "shapeleng", "shapelength", "stareashape", "stlengthshape", "shapestarea", "shapestlength",
        "lat", "lon", "lng", "latitude", "longitude", "tessellate", "extrude", "visibility",
        "url", "link", "website", "web", "homepage", "email", "mail", "phone", "phonenumber", "tel", "fax", "address", "street",
        "postcode", "zip", "zipcode", "color", "colour", "markercolor", "markersize", "markersymbol", "fill", "fillcolor", "fillopacity",
        "stroke", "strokecolor", "strokewidth", "strokeopacity", "linecolor", "linewidth", "styleurl", "stylehash", "stylemaphash",
        "icon", "iconcolor", "iconscale", "iconoffset", "iconoffsetunits", "iconopacity", "iconheading",
        "labelcolor", "labelscale", "labelopacity", "filloutline", "strokeoutline",
    }
)  # fmt: skip
"""Names of properties with identifiers, addresses and colours, in lower case without separators.

The values of these properties are not judged.
"""

_LIMIT_TEXT = re.compile(
    r"""
    (?<![\w#]) \d+ (?! \w )
    | (?<![\w#]) \d+ (?: [.,:h]\d+ )? \s*
        (?: m | km | cm | ft | nm | nmi | mi | sm | yd | h | hrs? | min | uhr | z | utc | lt | met\w+ | m[èe]tr\w+ | feet | foot ) (?! \w )
    | \b \d{1,2} h \d{2} \b | \b fl \s* \d{2,3} \b
    | \b p t? \d+ [ymwdhs]
    | \b (?:
        km | kilomet\w+ | met(?:er|re)s? | miles? | nautical | feet | ft | agl | [am]?msl | asl | gnd | sfc | unl | unlimited |
        h24 | h[jnxo] | s[rs] | sunrise | sunset | dusk | dawn | night\w* | daylight | daytime | daily | täglich | werktags? |
        weekdays? | weekends? | holidays? | summer | winter | seasonal | permanent\w* | temporar\w+ | until | notam |
        mon | monday | tue | tuesday | wed | wednesday | thu | thursday | fri | friday | sat | saturday | sun | sunday |
        (?: mo | di | mi | do | lun | mar | lu | ma ) \s? [-–] \s? \w{2,3} |
        (?: jan | feb | mar | apr | may | jun | jul | aug | sept? | oct | nov | dec ) \s? [-–] |
        january | february | march | april | june | july | august | september | october | november | december
      ) \b
    """,
    re.VERBOSE | re.IGNORECASE,
)
"""Parts of texts that may state a limit: numbers outside words, lengths, flight levels, vertical datums, dates and
times."""


def may_state_limit(name: str, value: Any) -> bool:
    """Return True if a property may state the size, altitude or time of a zone.

    Examples are `upperLimit: GND`, `VALID_FROM`, `buffer_km: 5`, `r: 500` and `remarks: up to 150 m AGL`.

    Args:
        name: Name of the property.
        value: Its value, as JSON. Lists and objects are judged by their contents.
    """
    pending = [(name, value)]
    while pending:
        key, item = pending.pop()
        if item in EMPTY:
            continue
        if _is_harmless(key):
            # The property itself states no limit, but objects in it may.
            for part in item if isinstance(item, list) else [item]:
                if isinstance(part, Mapping):
                    pending += [(str(inner), content) for inner, content in part.items()]
            continue
        if _names_limit(key):
            return True
        if isinstance(item, Mapping):
            pending += [(str(inner), part) for inner, part in item.items()]
        elif isinstance(item, list):
            pending += [(key, part) for part in item]
        elif _values_limit(item):
            return True
    return False


def _is_harmless(name: str) -> bool:
    return _compact(name) in _HARMLESS_NAMES


def _names_limit(name: str) -> bool:
    words = (word.lower() for part in _WORD.findall(name) for word in _CAPITALS.split(part))
    return any(_LIMIT_WORD.fullmatch(word) for word in words) or _LIMIT_STEM.search(_compact(name)) is not None


def _compact(name: str) -> str:
    return re.sub(r"[\W_]+", "", name).lower()


def _values_limit(value: Any) -> bool:
    if isinstance(value, str):
        return _LIMIT_TEXT.search(value) is not None
    return not isinstance(value, bool)

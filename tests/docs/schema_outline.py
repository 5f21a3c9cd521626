"""Outline the keys of a JSON document as nested Markdown lists, from its schema.

Equal neighbours share a line. Keys that an earlier object has too are described there only.
"""

import re
from itertools import groupby

UNTYPED = {"string": "", "boolean": "whether", "integer": "number of"}
"""Beginning of a description that states the type."""
MIN_SHARED_KEYS = {True: 2, False: 3}
"""Minimum number of described keys for which an outline refers to an earlier object.

The first number is that for an object of the same document.
"""
SHOWN = {"const", "$ref", "enum", "type", "description"}
"""Keywords that an outline shows, in addition to those that contain schemas."""
PLAIN = {"object", "string", "number", "integer", "boolean"}
"""Types that are written in the plural for a list."""
INTERVAL_END = re.compile(r"^(lower|upper) end of ", re.I)
"""Beginning of the descriptions of the two ends of an interval, which share a line."""


class Outliner:
    """Outlines documents one after the other, and refers to the objects that it has described.

    Attributes:
        described: place and keys of each object; a place is a document and a path in it.
        document: name of the present document.
    """

    def __init__(self):
        self.described = []
        self.document = ""

    def outline(self, name, schema):
        """Return the outline of a document as Markdown blocks, two for each form it may have."""
        self.document = name
        blocks = [sentence(schema["description"])] if "description" in schema else []
        for form in schema.get("anyOf", [schema]):
            if form is not schema and "description" in form:
                blocks.append(f"{form['description']}:")
            lines = [*self.lines(keys_of(form), "", 0)]
            blocks += ["\n".join(lines)] if lines else []
        return blocks

    def lines(self, keys, path, depth):
        """Yield the lines of an object's keys; `path` is the place of the object."""
        before = "    " * depth + "- "
        shared, where = self.find_shared(keys, path)
        if shared:
            yield f"{before}{code(shared)} {where}"
        if keys:
            self.described.append((self.document, path, keys))
        own = {name: schema for name, schema in keys.items() if name not in shared}
        for schema, group in groupby(own, key=own.get):
            names = list(group)
            below = [*self.lines(keys_of(entry(schema)), f"{path}{names[0]}.", depth + 1)]
            text = ": ".join(filter(None, [head(names, schema), description_of(schema)]))
            # Keys that fill one line need no list of their own.
            if len(below) == 1:
                text += f"{'; ' if description_of(schema) else ': '}{below.pop().lstrip(' -')}"
            yield before + text
            yield from below

    def find_shared(self, keys, path):
        """Return the keys that an earlier object has too, and a reference to this object."""
        found, where = [], ""
        for document, earlier_path, earlier in self.described:
            common = [name for name, schema in keys.items() if earlier.get(name) == schema]
            explained = [name for name in common if description_of(keys[name])]
            enough = len(explained) >= MIN_SHARED_KEYS[document == self.document]
            if enough and len(common) > len(found):
                found, where = common, self.reference(document, earlier_path, path)
        return found, where

    def reference(self, document, earlier_path, path):
        """Write a reference to an object that has been described."""
        if document != self.document:
            return f"as in [{document}](#{document})"
        return "as above" if path == earlier_path else f"as in `{earlier_path.removesuffix('.')}`"


def head(names, schema):
    """Return the names of equal keys with their type, if it has to be stated."""
    kind = kind_of(schema)
    return f"{code(names)} ({kind})" if kind else code(names)


def sentence(text):
    """Write a text as a sentence."""
    return text[0].upper() + text[1:] + "."


def code(names):
    """Write names as code."""
    return ", ".join(f"`{name}`" for name in names)


def description_of(schema):
    """Return the description of a schema."""
    return schema.get("description", "")


def entry(schema):
    """Return the schema of the entries of a list or a mapping; that of any other value is its own.

    Of a value with several forms, the form with keys is returned.
    """
    if isinstance(schema.get("additionalProperties"), dict):
        return entry(schema["additionalProperties"])
    if "items" in schema:
        return entry(schema["items"])
    return schema


def keys_of(schema):
    """Return the keys of an object, those of all its forms together."""
    keys = {name: shown(inner) for name, inner in schema.get("properties", {}).items()}
    for form in schema.get("anyOf", ()):
        for name, inner in keys_of(entry(form)).items():
            if keys.setdefault(name, inner) != inner:
                description = description_of(keys[name]) or description_of(inner)
                both = {"anyOf": [keys[name], inner]}
                keys[name] = both | ({"description": description} if description else {})
    return keys


def shown(schema):
    """Return a schema without what an outline does not show."""
    kept = {key: value for key, value in schema.items() if key in SHOWN}
    if "description" in schema:
        kept["description"] = INTERVAL_END.sub("Ends of ", schema["description"])
    if "properties" in schema:
        kept["properties"] = {name: shown(inner) for name, inner in schema["properties"].items()}
    if "anyOf" in schema:
        kept["anyOf"] = [shown(form) for form in schema["anyOf"]]
    for key in ("items", "additionalProperties"):
        if isinstance(schema.get(key), dict):
            kept[key] = shown(schema[key])
    return kept


def kind_of(schema):
    """Describe the type of a value in words; nothing if its description or its keys state it."""
    words = list_kinds(schema)
    described = description_of(schema).lower()
    if "null" in words and "null" in described:
        words.remove("null")
    if len(words) == 1:
        (word,) = words
        if word == "object" or (word in UNTYPED and described.startswith(UNTYPED[word])):
            return ""
    return either(words)


def either(words):
    """Write alternatives as words."""
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def list_kinds(schema):
    """List the types that a value may have, each in words."""
    if "const" in schema:
        return [f"`{schema['const']}`"]
    if "$ref" in schema:
        name, _, part = schema["$ref"].partition("#")
        name = name.partition(".")[0]
        return [f"as in [`{name}`](#{name})" if part else f"[`{name}`](#{name})"]
    if "enum" in schema:
        return ["null" if word is None else f"`{word}`" for word in schema["enum"]]
    if "anyOf" in schema and "type" not in schema:
        return list(dict.fromkeys(kind for form in schema["anyOf"] for kind in list_kinds(form)))
    kinds = schema.get("type", "any value")
    kinds = [kinds] if isinstance(kinds, str) else kinds
    return [
        name_list(schema)
        if kind == "array" and "items" in schema
        else name_mapping(schema)
        if kind == "object" and isinstance(schema.get("additionalProperties"), dict)
        else kind
        for kind in kinds
    ]


def name_list(schema):
    """Describe a list by the plural of its entries; objects are described below it."""
    kinds = plural(schema["items"])
    if kinds == "objects" or kinds.startswith("as in "):
        return kinds.replace("objects", "list").replace("as in", "list as in")
    return kinds if kinds.isalpha() else f"list of {kinds}"


def name_mapping(schema):
    """Describe an object whose keys are names."""
    kinds = plural(schema["additionalProperties"])
    return "by name" if kinds == "objects" else f"{kinds} by name"


def plural(schema):
    """Write the types of a value in the plural."""
    kinds = list_kinds(schema)
    if "items" in schema:
        return f"lists of {either(kinds)}"
    return either([f"{kind}s" if kind in PLAIN else kind for kind in kinds])

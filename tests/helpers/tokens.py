"""Tokens of the test arm, with fields accessed by name."""

from dataclasses import replace

from helpers.robots import arm
from morphgen.encoding.tokens import LAYOUT, tokens

FIELDS = {field.name: field.columns for field in LAYOUT}


def shapes_of(robot):
    return {link.name: link.collisions[0] for link in robot.links if link.collisions}


def arm_tokens(**changes):
    robot = replace(arm(), **changes)
    return tokens(robot, shapes_of(robot))


def field_of(token_array, name):
    return token_array[..., FIELDS[name]]

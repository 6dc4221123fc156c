"""Zones in the formats of others, each in a module of its own; `every` has them all.

Nothing is imported here: a service that draws zones into its recordings needs no reader of XML.
"""

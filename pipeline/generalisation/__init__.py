"""Generalisation of a city: cells between barriers, land use, and blocks of buildings (LoD0C, LoD0B, LoD0A)."""

"""Detail by rules: façades of city models with windows, doors and balconies: `citystitch detail`."""

RULES = ("apartments", "offices", "residential")  # the sets of rules that are files of this package

"""ASPRS classes of points that the steps use."""

# ASPRS LAS 1.4 R15, tables 9 and 17.
UNCLASSIFIED = 1
GROUND = 2
LOW_VEGETATION = 3
MEDIUM_VEGETATION = 4
HIGH_VEGETATION = 5
BUILDING = 6
LOW_NOISE = 7
KEY_POINT = 8  # of ground, up to LAS 1.3; 1.4 reserves the number
WATER = 9
RAIL = 10
ROAD = 11
WIRE_GUARD = 13
WIRE_CONDUCTOR = 14
TRANSMISSION_TOWER = 15
WIRE_CONNECTOR = 16
BRIDGE_DECK = 17
HIGH_NOISE = 18
OVERHEAD = 19  # conveyors, gantries of signs
SEA = (40, 41, 42, 43, 44, 45)  # bottom, surface and what is between; ASPRS topo-bathy domain profile
# Where a cloud has no building class, a point of any class but these may lie on a roof. Class 20 is ignored ground
# to LAS 1.4, but all that is not ground, buildings above all, to North Rhine-Westphalia.
NEVER_ROOF = (
    *(GROUND, LOW_VEGETATION, MEDIUM_VEGETATION, HIGH_VEGETATION, LOW_NOISE, KEY_POINT, WATER, RAIL, ROAD),
    *(WIRE_GUARD, WIRE_CONDUCTOR, TRANSMISSION_TOWER, WIRE_CONNECTOR, BRIDGE_DECK, HIGH_NOISE, OVERHEAD),
    *SEA,
)

"""Land cover: polygons of files as patches of the ground, water at one height, and trees as porous cells"""

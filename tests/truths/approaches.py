"""A small approach in legs: around a box, with a sphere that stands until \"go\", a turning cone and a corridor."""

LEGS = [
    {"name": "far", "position": [15.0, 0.0, 0.0], "tolerance": 0.3, "dwell": 30.0, "until": "go", "go_at": 130.0},
    {"name": "near", "position": [8.0, 1.0, 0.0], "tolerance": 0.3, "dwell": 40.0},
    {"name": "capture", "position": [3.6, 0.0, 0.0], "tolerance": 0.1, "dwell": 30.0},
]
SPHERE = {"name": "sphere", "shape": "sphere", "centre": [0.0, 0.0, 0.0], "radius": 12.0, "until": "go"}
SUN = {
    **{"name": "sun", "shape": "cone", "axes": "inertial", "centre": [0.0, 0.0, 0.0], "axis": [0.0, -1.0, 0.3]},
    **{"half_angle": 0.2, "length": 30.0},
}
CORRIDOR = {"name": "port", "port": [2.0, 0.0, 0.0], "axis": [1.0, 0.0, 0.0], "length": 10.0, "half_angle": 0.3}
TREE = {
    "duration": 640.0,
    "target": {"source": "box"},
    "field": {"source": "grid"},
    "orbit": {"semi_major_axis": 6.8e6},
    "start": {"position": [20.0, 0.0, 0.0]},
    "leg": LEGS,
    "zone": [SPHERE, SUN],
    "corridor": [CORRIDOR],
    "approach": {"speed_by_distance": [[12.0, 0.08], [4.0, 0.05], [1.0, 0.02]]},
}

"""What to do when the world is not as it was: another way, another place, another mode."""

from sb3_ddiffpg.planning.adaptation import Adaptation, adapt
from sb3_ddiffpg.planning.mode_planner import ModePlanner
from sb3_ddiffpg.planning.place_graph import PlaceGraph
from sb3_ddiffpg.planning.waypoint_policy import WaypointPolicy

__all__ = ["Adaptation", "ModePlanner", "PlaceGraph", "WaypointPolicy", "adapt"]

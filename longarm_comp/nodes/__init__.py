"""The ROS 2 nodes. Each one converts messages, calls the core and publishes the result."""

from longarm_comp.libraries import refuse_old_libraries

refuse_old_libraries()  # here, because a node's imports fail before its main could report it

EFFECTS, NETWORK = "--effects", "--network"
"""Options of a node's command line; the Python file that follows is executed."""
GUARD = "LONGARM_SUPERVISOR"
"""Environment variable with the supervisor's process id. Nodes end when this process is gone."""

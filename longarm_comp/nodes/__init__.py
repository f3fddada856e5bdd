"""The ROS 2 nodes. Each one converts messages, calls the core and publishes the result."""

from longarm_comp.libraries import refuse_old_libraries

refuse_old_libraries()  # here, because the imports of a node fail before its main can say so

EFFECTS, NETWORK = "--effects", "--network"
"""Options of a node's own command line before a Python file that it executes."""
GUARD = "LONGARM_SUPERVISOR"
"""Environment variable with the supervisor's process id. Its nodes end when it is gone."""

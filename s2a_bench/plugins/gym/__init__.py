"""Any gymnasium environment as a robot with a task. docs/situations/task.md."""

EXTRA = "gymnasium environments as robots"

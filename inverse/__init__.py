"""From observed to parameters: agents that act on an environment, and the database of what they tried."""

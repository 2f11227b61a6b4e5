"""Recording: one episode loop for agents and demonstrators, and what writes its episodes down."""

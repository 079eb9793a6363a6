"""Linear matrix inequalities and conic programmes (the only importer of cvxpy)."""

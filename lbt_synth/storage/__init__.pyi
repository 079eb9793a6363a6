from .resumable_runs import run_cases as run_cases

"""Systems whose matrix follows a parameter that moves in time: proofs, and counterexamples."""

from .controller import Controller as Controller
from .controller import estimator_form as estimator_form
from .estimation_problem import EstimationProblem as EstimationProblem
from .generalized_plant import GeneralizedPlant as GeneralizedPlant
from .norms import hinf_norm as hinf_norm
from .riccati.dare import solve_dare as solve_dare
from .state_space import StateSpace as StateSpace

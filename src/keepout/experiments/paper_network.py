"""Fields of the paper's own network, fitted before, where a reproduction was given a folder of them."""

from keepout.experiments.work import Work
from keepout.fields.model import FieldModel
from keepout.geometry.target import Target


def paper_network(work: Work, target: Target) -> FieldModel | None:
    """Read the field of the paper's network for a built-in target; None where there is none.

    Raises:
        FieldError: the file is damaged, or was made for another target.

    """
    if work.fields is None:
        return None
    path = work.fields / f"{target.name}.keepout"
    return FieldModel.load(path, target=target) if path.exists() else None

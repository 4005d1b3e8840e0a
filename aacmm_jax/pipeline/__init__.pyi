from .model_ladder import ComparedModels as ComparedModels

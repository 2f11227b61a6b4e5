from tests.recorded import DATASET_ID, minari_folder, workplace

__all__ = ["DATASET_ID", "minari_folder", "workplace"]

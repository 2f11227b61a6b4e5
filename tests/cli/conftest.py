from tests.zoo.conftest import minari_folder, workplace

__all__ = ["minari_folder", "workplace"]

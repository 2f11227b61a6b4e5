from tests.recorded import minari_folder, workplace

__all__ = ["minari_folder", "workplace"]

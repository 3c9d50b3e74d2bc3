//! The graphics API that wgpu uses.

use cubecl_wgpu::wgpu::Backend;
use cubecl_wgpu::{AutoGraphicsApi, GraphicsApi};

/// Whether wgpu would use OpenGL, because no device has Vulkan, Metal or DirectX 12. The program does not run on
/// OpenGL: kernels that are right on all other APIs give wrong numbers on Mesa's OpenGL.
pub fn is_opengl() -> bool {
    AutoGraphicsApi::backend() == Backend::Gl
}

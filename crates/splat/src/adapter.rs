//! The adapter behind the graphics layer.

use cubecl_wgpu::wgpu::Backend;
use cubecl_wgpu::{AutoGraphicsApi, GraphicsApi};

/// Whether wgpu would use OpenGL, because no device has Vulkan, Metal or DirectX 12. Such devices are not used: kernels that
/// are right on all others give wrong numbers on Mesa's OpenGL.
pub fn is_opengl() -> bool {
    AutoGraphicsApi::backend() == Backend::Gl
}

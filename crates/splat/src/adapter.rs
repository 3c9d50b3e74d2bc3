//! The adapter behind the graphics layer.

use cubecl_wgpu::wgpu::Backend;
use cubecl_wgpu::{AutoGraphicsApi, GraphicsApi};

/// Whether wgpu would take OpenGL, for want of Vulkan, Metal and DirectX 12, or of a card that answers to them. Nothing here uses
/// such a device: kernels that are right everywhere else give wrong numbers on Mesa's.
pub fn is_opengl() -> bool {
    AutoGraphicsApi::backend() == Backend::Gl
}
